"""Look-alike of Scaffold-GS's train.py: anchors that a network decodes, adjusted until `update_until`."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "scaffold_gs", 1, 20, 60


class GaussianModel(SplatModel):
    def __init__(self):
        super().__init__()
        self.mlp_color = torch.nn.Linear(3, 3)

    def training_setup(self, opt=None):
        super().training_setup(opt)
        self.optimizer.add_param_group({"params": list(self.mlp_color.parameters()), "lr": 0.01, "name": "mlp_color"})
        self.offset_gradient_accum = 0.0

    def training_statis(self, viewspace_points, visible_mask):
        self.offset_gradient_accum += float(viewspace_points.grad[0][visible_mask].norm())  # fails without a backward
        self.gathered += 1

    def prune_anchor(self, mask):
        for group in self.optimizer.param_groups:
            group["kept"] = group["name"].startswith("mlp")
        networks = [group for group in self.optimizer.param_groups if group.pop("kept")]
        self.optimizer.param_groups = [g for g in self.optimizer.param_groups if not g["name"].startswith("mlp")]
        SplatModel.prune_points(self, mask)
        self.optimizer.param_groups += networks

    def adjust_anchor(self, min_opacity):
        self._use_up()
        self.prune_anchor(self.values["opacity"][:, 0] < self.values["opacity"].quantile(min_opacity))


def prefilter_voxel(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0):
    return torch.ones(len(pc.values["xyz"]), dtype=torch.bool)


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, visible_mask=None, retain_grad=False):
    colors = pc.values["f_dc"] + pc.mlp_color(pc.values["f_rest"])
    return draw(viewpoint_camera, {**pc.values, "f_dc": colors})


def training(dataset, opt, pipe, dataset_name, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    first_iter += 1
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        mask = prefilter_voxel(viewpoint_cam, gaussians, pipe, None)
        retain_grad = iteration < opt.update_until
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, visible_mask=mask, retain_grad=retain_grad)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss = loss + 0.01 * torch.exp(gaussians.values["scaling"]).prod(dim=1).mean()
        loss.backward()
        with torch.no_grad():
            if iteration < opt.update_until and iteration > opt.start_stat:
                gaussians.training_statis(render_pkg["viewspace_points"], mask)
                if iteration > opt.update_from and iteration % opt.update_interval == 0:
                    gaussians.adjust_anchor(min_opacity=0.05)
            elif iteration == opt.update_until:
                del gaussians.offset_gradient_accum
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, update_until=20, update_interval=5, update_from=4, start_stat=2)
    return training(dataset(order), opt, None, "scene", checkpoint)
