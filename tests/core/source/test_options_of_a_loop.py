"""Options of a run in a loop's conditions: a condition behind an option that is off needs no iteration."""

import random
from types import SimpleNamespace

import pytest
from read_milestones import found

from skipgs_plug import SkipGSError

USE_PRUNE = False
SWITCHED = False
SAVES = []
ARGS = SimpleNamespace(prune=False, every=40)


def switch():
    global SWITCHED
    SWITCHED = True


def test_what_an_option_that_is_off_guards_is_irrelevant():
    """AbsGS prunes once a round of the views, whose number it learns in the loop, if an option says so."""

    def loop(stop, opt):
        views, stack, done = -1, None, 0
        for step in stop(opt=opt, views=views, stack=stack, done=done):
            if not stack:
                stack = ["a", "b", "c"]
                if views == -1:
                    views = len(stack)
            stack.pop()
            done += 2
            if step < opt.until and opt.prune:
                if step % views / 2 == 0 and step % 30 > views:
                    print("prune")
                if done % 20 == 0:
                    print("counted")
            if step % views == 0 and opt.prune:
                print("the option comes behind")
            if opt.prune or not opt.reset_every:
                pass
            elif step % opt.reset_every == 0:
                print("reset")

    off = SimpleNamespace(prune=False, until=80, reset_every=40)
    assert found(lambda stop: loop(stop, off)) == {"step % opt.reset_every == 0": [80]}
    on = SimpleNamespace(prune=True, until=80, reset_every=40)
    with (
        pytest.warns(RuntimeWarning, match="counts the iterations that run"),
        pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(step % views / 2 == 0"),
    ):
        found(lambda stop: loop(stop, on))
    with pytest.warns(RuntimeWarning, match="counts the iterations that run"):
        assert found(lambda stop: loop(stop, on), known={"views": 7}) == {
            "step % views / 2 == 0 and step % 30 > views": [56, 70, 77],
            "step % views == 0 and opt.prune": [56, 63, 70, 77, 84, 91, 98],
        }


def test_an_option_that_the_loop_switches_counts_as_on():
    def by_hand(stop):
        opt = SimpleNamespace(prune=False)
        for step in stop(opt=opt):
            if step == 60:
                opt.prune = True
            if opt.prune and step % 25 == 0:
                print("prune")

    def by_itself(stop):
        class Model:
            sparse = False

            def prune(self):
                self.sparse = True

        model = Model()
        for step in stop(model=model):
            if step == 60:
                model.prune()
            if model.sparse and step % 25 == 0:
                print("prune")

    assert found(by_hand)["opt.prune and step % 25 == 0"] == [50, 75]
    assert found(by_itself)["model.sparse and step % 25 == 0"] == [50, 75]


def test_a_flag_that_another_function_may_switch_counts_as_on():
    def loop(stop):
        pruning = False

        def begin():
            nonlocal pruning
            pruning = True

        for step in stop(pruning=pruning):
            if step == 60:
                begin()
            if pruning and step % 25 == 0:
                print("prune")

    assert found(loop)["pruning and step % 25 == 0"] == [50, 75]


@pytest.mark.parametrize(
    "guard",
    [
        "USE_PRUNE",
        "ARGS.prune",
        "cfg['prune']",
        "cfg.get('prune', False)",
        "cfg.get('other', False)",
        "getattr(ARGS, 'prune', True)",
        "getattr(ARGS, 'other', False)",
        "ARGS.every == 0",
        "cfg['train']['prune'] if ARGS.every else True",
    ],
)
@pytest.mark.parametrize("by", ["if", "continue"])
def test_condition_behind_an_option_that_is_off_may_be_unforeseeable(guard, by, tmp_path):
    body = {
        "if": f"if {guard}:\n            if step % n == 0:\n                print('prune')",
        "continue": f"if not ({guard}):\n            continue\n        if step % n == 0:\n            print('prune')",
    }
    script = tmp_path / "script.py"
    script.write_text(LOOP.format(body=body[by]))
    names = {"USE_PRUNE": USE_PRUNE, "ARGS": ARGS, "random": random}
    exec(compile(script.read_text(), script, "exec"), names)
    assert found(names["loop"]) == {"step == 70": [70]}
    names.update(USE_PRUNE=True, ARGS=SimpleNamespace(prune=True, other=True, every=0))
    names["CFG"].update(prune=True, other=True)
    with pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(step % n == 0\)"):
        found(names["loop"])


LOOP = """
CFG = {{"prune": False, "train": {{"prune": False}}}}
def loop(stop):
    cfg, n = CFG, 1
    for step in stop(cfg=cfg, n=n):
        n += random.randint(1, 3)
        if step == 70:
            print("save")
        {body}
"""


def test_option_that_any_function_may_change_counts_as_on():
    def loop(stop):
        cfg = {"prune": False}
        assert [-SAVES for SAVES in range(2)] == [0, -1]  # SAVES here is not a variable of the function
        for step in stop(cfg=cfg):
            if SWITCHED and step % 30 == 0:
                switch()
            if SAVES and step % 40 == 0:
                print("save")
            if cfg["prune"] and step % 45 == 0:
                cfg.update(prune=True)

    assert sorted(number for numbers in found(loop).values() for number in numbers) == [60, 80, 90, 90]


def test_iteration_that_ends_early_reaches_no_later_condition():
    def loop(stop):
        for step in stop(off=False):
            if step < 60:
                if step % 2:
                    continue
            elif step > 90:
                print("late")
                break
            with open("/dev/null") as _:
                if step in (61, 62, 63):
                    continue
            for _ in range(2):
                if step == 64:
                    break  # ends the inner loop only
            if step in (51, 52, 61, 64, 95):
                print("save")

    assert found(loop)["step in (51, 52, 61, 64, 95)"] == [52, 64]


def test_what_a_loop_names_from_an_option_is_foreseen():
    """Mini-Splatting and GaussianSpa give a name to an option in each iteration."""

    def loop(stop):
        args = SimpleNamespace(simplify=70)
        for step in stop(args=args):
            end = args.simplify
            if step == end:
                print("simplify")
            if step % 20 == 0 and step > end:
                print("SH")

    assert found(loop) == {"step == args.simplify": [70], "step % 20 == 0 and step > args.simplify": [80]}


def test_what_a_loop_assigns_once_from_unchanging_things_is_foreseen():
    def loop(stop):
        views, cfg, opt = [object()] * 17, {"every": 20}, SimpleNamespace(fast=True)
        for step in stop(views=views, cfg=cfg, opt=opt):
            n = len(views)
            every = cfg["every"] * 2
            late = 90 if opt.fast else 10
            rounds: int = n * 2
            if step % n == 0 or step % rounds == 0:
                print("round")
            if step % every == 0:
                print("save")
            if step == late:
                print("late")

    assert [*found(loop).values()] == [[51, 68, 85], [80], [90]]


def test_length_of_a_list_that_the_loop_changes_is_not_foreseen():
    def grows(stop):
        views = [object()] * 17
        for step in stop(views=views):
            n = len(views)
            if step % n == 0:
                views.append(step)

    def assigned_twice(stop):
        views = [object()] * 17
        for step in stop(views=views):
            n = len(views)
            if step % n == 0:
                n = 3

    for loop in (grows, assigned_twice):
        with pytest.raises(SkipGSError, match="cannot be evaluated ahead"):
            found(loop)


def test_length_does_not_show_that_a_condition_never_holds():
    """A function that the loop calls may fill a list, so that a condition on its length holds later."""

    def loop(stop):
        seen = [object()]
        for step in stop(seen=seen):
            count = len(seen)
            if count > 100 and step % 30 == 0:
                print("save")

    assert [*found(loop).values()] == [[60, 90]]


class Holdout:
    def is_due(self, step):
        return step % random.randint(1, 9) == 0


class Trainer:
    """As gsplat-trainer's, which stops early if a handler says so; most runs have no handler."""

    def __init__(self):
        self.holdout = self.made = self.every = None
        self.parts = SimpleNamespace(early=Holdout())
        self.parts.early.limit = None

    def make(self):
        self.made = Holdout()

    def train(self, stop):
        n = 1
        for step in stop(self=self, n=n):
            n += random.randint(1, 3)
            if self.holdout is not None and not self.holdout.is_due(step):
                print("stop")
            if self.every and step % n == 0:
                print("save")
            if self.parts.early.limit is not None:
                print("late" if step % n == 0 else "early")
            if step == 70:
                print("evaluate")

    def train_with_what_is_made_later(self, stop):
        for step in stop(self=self):
            self.make_at(step)
            if self.made is not None and not self.made.is_due(step):
                print("stop")

    def make_at(self, step):
        if step == 60:
            getattr(self, "make")()  # noqa: B009  # a call that is not read

    def train_with_what_is_set(self, stop):
        self.handler = Holdout()
        for step in stop(self=self):
            if self.handler is not None and not self.handler.is_due(step):
                print("stop")


def method(name):
    """A method of a trainer as a function of its own."""
    trainer = Trainer()

    def loop(stop):
        getattr(trainer, name)(stop)

    return loop


def test_a_part_of_a_trainer_that_is_none_guards_nothing():
    assert found(method("train")) == {"step == 70": [70]}


@pytest.mark.parametrize("name", ["train_with_what_is_made_later", "train_with_what_is_set"])
def test_a_part_of_a_trainer_that_a_method_makes_later_is_not_none(name):
    with pytest.raises(SkipGSError, match="cannot be evaluated ahead"):
        found(method(name))


def test_no_method_changes_what_is_none():
    def loop(stop):
        writer, bar, n = None, None, 1
        for step in stop(writer=writer, bar=bar, n=n):
            n += random.randint(1, 3)
            if writer is not None and step % n == 0:
                writer.add(step)
            if bar and step % n == 0:
                bar.update(1)
            if step == 70:
                print("save")

    def makes_one(stop):
        writer, n = None, 1
        for step in stop(writer=writer, n=n):
            n += random.randint(1, 3)
            if step == 55:
                writer = set()
            if writer is not None and step % n == 0:
                writer.add(step)

    assert found(loop) == {"step == 70": [70]}
    with pytest.raises(SkipGSError, match="cannot be evaluated ahead"):
        found(makes_one)


def test_a_condition_inside_one_whose_iterations_all_run_need_not_be_evaluated():
    def loop(stop):
        best = 0
        for step in stop(best=best):
            if step % 40 == 0:
                print("save")
                if step != best:
                    print("delete the older one")
                best = step

    assert found(loop) == {"step % 40 == 0": [80]}


def test_keys_and_values_of_a_table_are_read_ahead():
    def loop(stop):
        optimizers = SimpleNamespace(parameters={"means": [object()], "scales": [object()]})
        every = {"means": 30, "scales": 40}
        for step in stop(optimizers=optimizers, every=every):
            print([every[name] for name, _ in optimizers.parameters.items() if step % every[name] == 0])

    assert list(found(loop).values()) == [[60, 80, 90]]
