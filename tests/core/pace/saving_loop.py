"""A loop of a user with a save by number, a rate by number and Adam."""

import torch

VIEWS = [f"{i}.png" for i in range(4)]


class Loop:
    """A training loop with a save by number, a rate by number and Adam, like real loops."""

    def __init__(self, begin=0, end=100, value=None, moments=None):
        self.begin, self.end = begin, end
        self.value = torch.nn.Parameter(torch.tensor([2.0, -1.0]) if value is None else value.clone())
        self.optimizer = torch.optim.Adam([self.value], lr=0.1)
        if moments is not None:
            self.optimizer.load_state_dict(moments)
        self.ran, self.saved, self.rates = [], [], []

    def train(self, gate, **options):
        for step in gate.iterations(range(self.begin, self.end), **options):
            self.train_step(gate, step)
            self.rates.append(self.optimizer.param_groups[0]["lr"])
            if step % 25 == 0:
                self.saved.append(step)
        return self

    def train_step(self, gate, step):
        self.ran.append(step)
        self.optimizer.param_groups[0]["lr"] = 0.1 * 0.99**step
        loss = (self.value - step % 3).square().sum()
        if gate.backward(loss, view=VIEWS[step % 4], step=step):
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
