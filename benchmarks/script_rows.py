"""Rows of the table of unmodified scripts: the script, its project and its schedule."""

from typing import NamedTuple


class Row(NamedTuple):
    """One script with its options.

    Attributes:
        label: Name in the table.
        project: Owner and name of the repository on GitHub.
        folder: Name of its checkout in the folder of all checkouts.
        command: Command line of the script, with placeholders {scene}, {factor}, {out}, {sized} (the folder that
            `sized_scene` writes), {training} (the same without held-out views) and those of `schedule`.
        pictures: Whether the project's own renders are measured, because no PLY contains the model in the scene's
            coordinates.
        render: Command line that renders these pictures after training, if the script does not. Its seconds are not
            counted.
    """

    label: str
    project: str
    folder: str
    command: str
    pictures: bool = False
    render: str = ""


# Densification thresholds for images of 126x94 pixels. With the projects' own, which are for large photographs, scenes
# would grow to ten times as many Gaussians.
_SAVED = "-s {scene} -r 1 --eval -m {out} --iterations {n} --save_iterations {n} "
_SCENE = f"{_SAVED}-i images_{{factor}} --test_iterations -1 "
_GROWS = "--densify_from_iter 150 --densify_until_iter {half} --densification_interval 100 "
_INRIA = f"train.py {_SCENE}{_GROWS}"
_COARSE = "--densify_grad_threshold 0.001 "
_GSPLAT = (
    "--data_dir {scene} --data_factor {factor} --result_dir {out} --max_steps {n} --save_steps {n} --eval_steps {n} "
    "--ply_steps {n} --save_ply --strategy.refine-start-iter 150 --disable_viewer --disable_video "
)
_ANCHORS = f"train.py {_SAVED}--images images_{{factor}} --update_until {{half}} --start_stat 100 --update_from 200 "
# Without evaluations in between and at constant resolution, as the other scripts. Opacities are reset after every 3,000
# iterations, nerfstudio's own interval, as in gsplat's script. The lists in {sized} go before the interval.
_NERFSTUDIO = (
    "--output-dir {out} --experiment-name run --timestamp model --vis tensorboard --max-num-iterations {n} "
    "--steps-per-save {n} --steps-per-eval-image 0 --steps-per-eval-all-images 0 --pipeline.model.num-downscales 0 "
    "--pipeline.model.warmup-length 150 --pipeline.model.refine-every 100 --pipeline.model.stop-split-at {half} "
    "--pipeline.model.densify-grad-thresh 0.001 --optimizers.means.scheduler.max-steps {n} "
    "colmap --data {sized} --downscale-factor 1 --colmap-path sparse/0 --eval-mode interval --eval-interval 8"
)

ROWS = {
    "inria": Row(
        "Inria 3DGS `train.py`, as DashGaussian ships it",
        "YouyuChen0207/DashGaussian",
        "DashGaussian",
        f"{_INRIA}{_COARSE}--disable_viewer",
    ),
    "fastgs": Row("FastGS", "fastgs/FastGS", "FastGS", _INRIA),
    "taming": Row(
        "Taming 3DGS",
        "humansensinglab/taming-3dgs",
        "taming-3dgs",
        f"{_INRIA.replace('_iter 150', '_iter 100')}--budget 8 --percent_dense 0.1",
    ),
    "mcmc": Row(
        "3DGS-MCMC",
        "ubc-vision/3dgs-mcmc",
        "3dgs-mcmc",
        f"train.py {_SCENE}--densify_from_iter 150 --densify_until_iter {{late}} --densification_interval 40 "
        "--init_type sfm --cap_max 12000",
    ),
    "mip_splatting": Row(
        "Mip-Splatting", "autonomousvision/mip-splatting", "mip-splatting", f"{_INRIA}{_COARSE}".replace("-1", "{n}", 1)
    ),
    "absgs": Row("AbsGS", "TY424/AbsGS", "AbsGS", f"{_INRIA}{_COARSE}--densify_grad_abs_threshold 0.002"),
    "pixel_gs": Row("Pixel-GS", "zhengzhang01/Pixel-GS", "Pixel-GS", f"{_INRIA}{_COARSE}"),
    "speedy_splat": Row(
        "Speedy-Splat",
        "j-alex-hanson/speedy-splat",
        "speedy-splat",
        f"{_INRIA}--densify_grad_threshold 0.0005 --prune_from_iter {{fifth}} --prune_until_iter {{n}} "
        "--prune_interval {tenth}",
    ),
    "scaffold_gs": Row(
        "Scaffold-GS",
        "city-super/Scaffold-GS",
        "Scaffold-GS",
        f"{_ANCHORS}--test_iterations {{n}} --voxel_size 0.001",
        pictures=True,
    ),
    "octree_gs": Row(
        "Octree-GS",
        "city-super/Octree-GS",
        "Octree-GS",
        # It ignores --images, and reads the folder of the factor --ds.
        f"{_ANCHORS.replace('--images images_{factor}', '--ds {factor}')}--test_iterations -1 --update_interval 50 "
        "--appearance_dim 0 --visible_threshold 0.9",
        pictures=True,
    ),
    "dash_gaussian": Row(
        "DashGaussian `train_dash.py`",
        "YouyuChen0207/DashGaussian",
        "DashGaussian",
        f"{_INRIA.replace('train.py', 'train_dash.py')}--disable_viewer --densify_mode freq --resolution_mode freq",
    ),
    "improved_gs": Row(
        "Improved-GS",
        "XiaoBin2001/Improved-GS",
        "Improved-GS",
        f"{_INRIA.replace('_iter 150', '_iter 310')}--budget 20000",
    ),
    "gns": Row(
        "GNS",
        "XiaoBin2001/GNS",
        "GNS",
        f"{_INRIA.replace('_iter 150', '_iter 310')}--budget 20000 --final_budget 10000 --reg_start {{half}} "
        "--reg_end {late}",
    ),
    "lightgaussian": Row(
        "LightGaussian `train_densify_prune.py`",
        "VITA-Group/LightGaussian",
        "LightGaussian",
        f"{_INRIA.replace('train.py', 'train_densify_prune.py')}{_COARSE}--prune_iterations {{two_thirds}} {{late}}",
    ),
    "mini_splatting": Row(
        "Mini-Splatting `ms/train.py`",
        "fatPeter/mini-splatting",
        "mini-splatting",
        f"ms/{_INRIA}--imp_metric outdoor --simp_iteration1 {{half}} --simp_iteration2 {{two_thirds}}",
    ),
    "gaussianspa": Row(
        "GaussianSpa `train_op.py`",
        "noodle-lab/GaussianSpa",
        "GaussianSpa",
        f"{_INRIA.replace('train.py', 'train_op.py')}{_COARSE}--optimizing_spa_start_iter {{half}} "
        "--optimizing_spa_stop_iter {two_thirds}",
    ),
    "perceptual_gs": Row("Perceptual-GS", "eezkni/Perceptual-GS", "Perceptual-GS", _INRIA),
    "gsplat": Row(
        "gsplat 1.5.3 `simple_trainer.py default`",
        "nerfstudio-project/gsplat",
        "gsplat-1.5.3",
        f"examples/simple_trainer.py default {_GSPLAT}--strategy.refine-stop-iter {{half}} --strategy.refine-every 100 "
        "--strategy.grow-grad2d 0.001",
        pictures=True,
    ),
    "gsplat_mcmc": Row(
        "gsplat 1.5.3 `simple_trainer.py mcmc`",
        "nerfstudio-project/gsplat",
        "gsplat-1.5.3",
        f"examples/simple_trainer.py mcmc {_GSPLAT}--strategy.refine-stop-iter {{late}} --strategy.refine-every 40 "
        "--strategy.cap-max 12000",
        pictures=True,
    ),
    "step_trainer": Row(
        "pip gaussian-splatting 2.11.0, `densify`",
        "PyPI/gaussian-splatting",
        "gaussian-splatting",
        "-m gaussian_splatting.train -s {training} -d {out} -i {n} --save_iterations {n} --mode densify "
        "-o densify_from_iter=150 -o densify_until_iter={half} -o densify_grad_threshold=0.001 -o prune_from_iter=150 "
        "-o prune_until_iter={half} -o opacity_reset_until_iter={half}",
    ),
    "nerfstudio": Row(
        "nerfstudio `ns-train splatfacto`",
        "nerfstudio-project/nerfstudio",
        "nerfstudio",
        f"-m nerfstudio.scripts.train splatfacto {_NERFSTUDIO}",
        pictures=True,
        render="-m nerfstudio.scripts.eval --load-config {out}/run/splatfacto/model/config.yml "
        "--output-path {out}/eval.json --render-output-path {out}/renders",
    ),
}


def schedule(n: int) -> dict[str, int]:
    """Return the values of the placeholders in commands, for a schedule of `n` iterations."""
    return {"n": n, "half": n // 2, "late": n * 5 // 6, "two_thirds": n * 2 // 3, "fifth": n // 5, "tenth": n // 10}
