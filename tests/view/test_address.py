"""Where the page in the browser may listen, and that it hears its visitors."""

import socket
import threading

import pytest
import torch

from skipgs_plug.trainer import InputError
from skipgs_plug.view import page as module
from skipgs_plug.view.page import Page, require_address


@pytest.mark.parametrize(
    "host, port, complaint",
    [
        ("127.0.0.1", 65536, "port=65536 is not in 1..65535"),
        ("127.0.0.1", 0, "port=0 is not in 1..65535"),
        ("nowhere.invalid", 8080, r"Cannot listen on nowhere.invalid:8080 \("),
        ("203.0.113.1", 8080, r"Cannot listen on 203.0.113.1:8080 \("),  # an address reserved for documentation
    ],
)
def test_an_address_that_cannot_be_is_refused_before_anything_waits_for_it(host, port, complaint):
    with pytest.raises(InputError, match=complaint):
        Page(None, lambda splats, view: None, host=host, port=port)


def test_what_is_chosen_while_a_model_is_prepared_is_not_forgotten(monkeypatch):
    page = Page(None, lambda splats, view: None, steps=[100, 200, 300], port=18471)
    convert = module.to_gaussians

    def while_somebody_chooses(*arguments):
        page._slider.value = 0
        return convert(*arguments)

    monkeypatch.setattr(module, "to_gaussians", while_somebody_chooses)
    splats = {"means": torch.zeros(2, 3), "quats": torch.ones(2, 4), "scales": torch.zeros(2, 3)}
    try:
        page.show({**splats, "opacities": torch.zeros(2), "sh0": torch.zeros(2, 1, 3)}, "Iteration 300")
        waiting = threading.Thread(target=page.wait, daemon=True)
        waiting.start()
        waiting.join(10)
        assert not waiting.is_alive() and page.chosen_step == 100
        assert not page._asked.is_set()
    finally:
        page.stop()


def test_a_port_that_is_taken_is_left_to_the_server_which_takes_the_next():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        require_address("127.0.0.1", taken.getsockname()[1])
