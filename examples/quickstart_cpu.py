"""Gate the reference trainer on a small ray-traced scene: no GPU, no download, about a minute.

    python examples/quickstart_cpu.py

`skipgs-plug demo` does the same at full size, beside an ungated run.
"""

import sys

from skipgs_plug import SkipGate
from skipgs_plug.trainer import TrainConfig, Trainer
from skipgs_plug.trainer.synthetic import make_scene


def main(max_steps: int = 600) -> None:
    scene = make_scene(n_views=24, width=96, height=72, n_points=2000)
    trainer = Trainer(TrainConfig(max_steps=max_steps), scene)
    gate = SkipGate(trainer)  # the one line that adds the method
    trainer.train()
    print(gate.summary())
    result = trainer.evaluate()
    print(f"PSNR {result['psnr']:.2f} dB on {result['views']} held-out views, {trainer.t_post:.1f} s of refinement")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:2]))
