"""CUDA requests land on the CPU inside the block, and nothing is left of it outside."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from skipgs_plug.scripts.cuda_redirect import REPLACED, HostEvent, cuda_on_cpu

CALLS = {
    "tensor": lambda: torch.tensor([1.0], device="cuda"),
    "zeros with index": lambda: torch.zeros(2, device="cuda:0"),
    "zeros on a device object": lambda: torch.zeros(2, device=torch.device("cuda")),
    "zeros_like": lambda: torch.zeros_like(torch.ones(2), device="cuda"),
    "arange": lambda: torch.arange(3, device="cuda"),
    "as_tensor": lambda: torch.as_tensor([1.0], device="cuda"),
    "Tensor.cuda": lambda: torch.ones(2).cuda(),
    "Tensor.cuda with index": lambda: torch.ones(2).cuda(0),
    "legacy constructor": lambda: torch.Tensor([1.0, 2.0]).cuda(),
    "Tensor.to": lambda: torch.ones(2).to("cuda"),
    "Tensor.to by keyword": lambda: torch.ones(2).to(device="cuda", non_blocking=True),
    "Tensor.to with index": lambda: torch.ones(2).to(0),
    "Tensor.to with a dtype": lambda: torch.ones(2).to("cuda", torch.float64),
    "Module.cuda": lambda: torch.nn.Linear(2, 2).cuda().weight,
    "Module.to": lambda: torch.nn.Linear(2, 2).to("cuda").weight,
    "FloatTensor": lambda: torch.cuda.FloatTensor([1.0]),
    "pin_memory": lambda: torch.ones(2).pin_memory(),
    "pinned factory": lambda: torch.ones(2, pin_memory=True),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_every_way_to_ask_for_cuda_gives_a_cpu_tensor(call):
    with cuda_on_cpu():
        value = call()
    assert value.device.type == "cpu"


def test_values_dtypes_and_gradients_pass_through():
    with cuda_on_cpu():
        leaf = torch.tensor([1.0, 2.0], device="cuda", requires_grad=True)
        moved = leaf.to("cuda", torch.float64)
        moved.square().sum().backward()
    assert moved.dtype == torch.float64
    assert leaf.grad.tolist() == [2.0, 4.0]


class Doubled(torch.autograd.Function):
    """A function as scripts write it: its backward asks for CUDA."""

    @staticmethod
    def forward(ctx, value):
        return 2 * value

    @staticmethod
    def backward(ctx, gradient):
        return torch.full([2], 2.0, device="cuda") * gradient.cuda()


@pytest.mark.parametrize("as_method", [True, False])
def test_the_scripts_own_code_in_a_backward_pass_is_redirected(as_method):
    hooked = []
    with cuda_on_cpu():
        leaf = torch.ones(2, device="cuda", requires_grad=True)
        leaf.register_hook(lambda gradient: hooked.append(gradient.to("cuda")))
        loss = Doubled.apply(leaf).sum()
        gradient = loss.backward() if as_method else torch.autograd.grad(loss, leaf)[0]
    assert (leaf.grad if as_method else gradient).tolist() == hooked[0].tolist() == [2.0, 2.0]


def test_device_calls_that_only_order_work_do_nothing():
    with cuda_on_cpu():
        torch.cuda.synchronize()
        torch.cuda.set_device(torch.device("cuda:0"))
        torch.cuda.reset_peak_memory_stats()
        torch.cuda.empty_cache()
        assert torch.cuda.is_available() and torch.cuda.device_count() == 1
        assert torch.cuda.current_device() == 0


def test_questions_about_the_device_are_answered_for_the_cpu():
    with cuda_on_cpu():
        properties = torch.cuda.get_device_properties(0)
        assert torch.cuda.get_device_name() == torch.cuda.get_device_name(0) == properties.name == "CPU"
        assert torch.cuda.get_device_capability() == (properties.major, properties.minor) == (0, 0)
        free, total = torch.cuda.mem_get_info(torch.device("cuda"))
        assert free > 0 and total > 0 and properties.total_memory > 0
        assert torch.cuda.memory_summary() == ""
        torch.cuda.ipc_collect()


def test_events_measure_the_host():
    with cuda_on_cpu():
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        end.record()
        end.synchronize()
        assert end.query()
        assert start.elapsed_time(end) >= 0
        with pytest.raises(RuntimeError, match="recorded"):
            start.elapsed_time(torch.cuda.Event())


def test_a_checkpoint_saved_on_cuda_loads(tmp_path):
    torch.save({"a": torch.ones(2)}, tmp_path / "a.pt")
    with cuda_on_cpu():
        for place in ({}, {"map_location": "cuda"}, {"map_location": torch.device("cuda:0")}):
            assert torch.load(tmp_path / "a.pt", **place, weights_only=True)["a"].device.type == "cpu"


def test_optimizers_run_inside():
    with cuda_on_cpu():
        parameter = torch.nn.Parameter(torch.ones(2, device="cuda"))
        optimizer = torch.optim.Adam([parameter], lr=0.1)
        parameter.sum().backward()
        optimizer.step()
    assert (parameter < 1).all()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # PyTorch's own, on loading its compiler
def test_compiled_functions_run_uncompiled():
    @torch.compile
    def doubled(values):
        assert not torch.compiler.is_compiling()
        return 2 * values

    with cuda_on_cpu():
        assert doubled(torch.ones(2, device="cuda")).tolist() == [2.0, 2.0]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # PyTorch's own, on loading its compiler
def test_threads_are_redirected_too():
    def train():
        leaf = torch.ones(2, device="cuda", requires_grad=True)
        torch.compile(lambda: leaf.cuda().sum())().backward()
        return leaf.grad.tolist()

    with cuda_on_cpu(), ThreadPoolExecutor(1) as pool:
        assert pool.submit(train).result() == [1.0, 1.0]


def resolved(name: str, default: object) -> object:
    _, module, attribute = name.split(".")
    return getattr(getattr(torch, module, None), attribute, default)


@pytest.mark.skipif(not hasattr(torch, "accelerator"), reason="this torch has no torch.accelerator")
def test_torch_itself_finds_no_device(monkeypatch):
    # A build with CUDA gives this answer without a GPU once `torch.cuda.is_available` is replaced.
    monkeypatch.setattr(torch.accelerator, "current_accelerator", lambda check_available=False: torch.device("cuda"))
    with cuda_on_cpu():
        leaf = torch.ones(2, device="cuda", requires_grad=True)
        optimizer = torch.optim.Adam([leaf])
        leaf.sum().backward()
        optimizer.step()
        assert torch.accelerator.current_accelerator(check_available=True) is None
    assert leaf[0] < 1 and torch.accelerator.current_accelerator().type == "cuda"


def test_torch_optimizers_step_without_a_driver(monkeypatch):
    def no_driver() -> bool:  # as a build with CUDA answers where there is no driver
        raise RuntimeError("CUDA driver version is insufficient for CUDA runtime version")

    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", no_driver)
    with cuda_on_cpu():
        leaf = torch.ones(2, device="cuda", requires_grad=True)
        leaf.sum().backward()
        torch.optim.Adam([leaf]).step()
    assert leaf[0] < 1


@pytest.mark.parametrize("fails", [False, True])
def test_everything_is_back_afterwards(fails):
    missing = object()

    def present() -> dict[str, object]:
        return {name: resolved(name, missing) for name in REPLACED}

    before = present()
    load = torch.load
    try:
        with cuda_on_cpu():
            assert torch.cuda.Event is HostEvent
            if fails:
                raise KeyError("stop")
    except KeyError:
        pass
    assert present() == before
    assert torch.load is load
    if not torch.cuda.is_available():
        with pytest.raises((AssertionError, RuntimeError)):
            torch.ones(1).cuda()


def test_autocast_for_cuda_changes_nothing():
    """In bfloat16 too, for which torch asks the device."""
    ones = torch.ones(2, 2)
    with cuda_on_cpu(), torch.autocast("cuda", torch.bfloat16):
        assert (ones @ ones).dtype == torch.float32
