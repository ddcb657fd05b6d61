"""A look-alike of Inria's checkout that asks for CUDA and its extension modules."""

import json
import sys
import textwrap
from pathlib import Path

RENDERER = """
    import torch
    from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

    def render(camera, model):
        points = torch.zeros_like(model.xyz, requires_grad=True, device="cuda")
        settings = GaussianRasterizationSettings(
            image_height=16, image_width=16, tanfovx=0.5, tanfovy=0.5, bg=torch.zeros(3, device="cuda"),
            scale_modifier=1.0, viewmatrix=torch.eye(4).cuda(), projmatrix=camera.projection,
            sh_degree=0, campos=torch.zeros(3), prefiltered=False, debug=False)
        image, radii = GaussianRasterizer(settings)(
            means3D=model.xyz, means2D=points, opacities=torch.full((len(model.xyz), 1), 0.8).cuda(),
            colors_precomp=model.color, scales=torch.full((len(model.xyz), 3), 0.2).cuda(),
            rotations=torch.tensor([[1.0, 0, 0, 0]]).cuda().repeat(len(model.xyz), 1))
        return {"render": image, "radii": radii}
"""


MODEL = """
    import torch
    from simple_knn._C import distCUDA2

    class GaussianModel:
        def __init__(self):
            rng = torch.Generator().manual_seed(0)
            points = torch.rand(12, 3, generator=rng) - 0.5 + torch.tensor([0, 0, 2.0])
            assert (distCUDA2(points.cuda()) > 0).all()
            self.xyz = torch.nn.Parameter(points.cuda())
            self.color = torch.nn.Parameter(torch.rand(12, 3, generator=rng).cuda())

        def training_setup(self):
            self.optimizer = torch.optim.Adam([self.xyz, self.color], lr=0.01)

        def update_learning_rate(self, iteration):
            pass
"""


TRAIN = """
    import random, sys
    from types import SimpleNamespace
    import torch
    from gaussian_renderer import render
    from scene.gaussian_model import GaussianModel

    class Camera:
        def __init__(self, name, shade):
            self.image_name = name
            self.image = torch.full((3, 16, 16), shade, device="cuda")
            self.projection = torch.diag(torch.tensor([2.0, 2.0, 1.0, 0.0]))
            self.projection[2, 3] = 1.0

    def training(opt, out):
        gaussians = GaussianModel()
        gaussians.training_setup()
        first = 1
        if "--start" in sys.argv:
            (gaussians.xyz, gaussians.color), adam, first = torch.load(sys.argv[sys.argv.index("--start") + 1])
            gaussians.training_setup()
            gaussians.optimizer.load_state_dict(adam)
            first += 1
        name, more = "room" if "--room" in sys.argv else "view", 5.0 if "--bright" in sys.argv else 0.0
        cameras = [Camera(f"{name}{i}", more + 0.2 * i) for i in range(4)]
        scene = SimpleNamespace(model_path=out, getTrainCameras=lambda: cameras)
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        for iteration in range(first, opt.iterations + 1):
            start.record()
            gaussians.update_learning_rate(iteration)
            viewpoint_cam = random.Random(iteration).choice(cameras)
            loss = (render(viewpoint_cam, gaussians)["render"] - viewpoint_cam.image).abs().mean()
            if "--fail" in sys.argv and iteration == 5:
                sys.exit(3)
            loss.backward()
            end.record()
            if iteration < opt.densify_until_iter:
                pass  # densification
            torch.cuda.synchronize()
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
            if "--save" in sys.argv and iteration in (10, 40):
                saved = (gaussians.xyz, gaussians.color), gaussians.optimizer.state_dict(), iteration
                torch.save(saved, f"{out}/chkpnt{iteration}.pth")
        torch.save((gaussians.xyz, gaussians.color), out + "/model.pth")

    if __name__ == "__main__":
        random.seed(0)
        if "--idle" not in sys.argv:
            training(SimpleNamespace(iterations=60, densify_until_iter=20), sys.argv[1])
        print("Training complete.")
"""


def write_checkout(folder: Path) -> Path:
    """Write the look-alike's files and return the path of its train.py."""
    (folder / "gaussian_renderer").mkdir(parents=True)
    (folder / "scene").mkdir()
    (folder / "gaussian_renderer" / "__init__.py").write_text(textwrap.dedent(RENDERER))
    (folder / "scene" / "__init__.py").write_text("")
    (folder / "scene" / "gaussian_model.py").write_text(textwrap.dedent(MODEL))
    (folder / "train.py").write_text(textwrap.dedent(TRAIN))
    return folder / "train.py"


def forget() -> None:
    """Remove the look-alike's modules, so that the next script imports its own."""
    for name in ("gaussian_renderer", "scene", "scene.gaussian_model"):
        sys.modules.pop(name, None)


def counted(folder: Path) -> dict:
    """Return the counts in the skipgs.json of a run."""
    report = json.loads((folder / "skipgs.json").read_text())
    return {name: report[name] for name in ("iterations", "gated_iterations", "backwards_skipped", "reasons")}
