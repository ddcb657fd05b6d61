"""Where the page in the browser may listen, and that it hears its visitors."""

import contextlib
import errno
import re
import socket
import threading
import urllib.request
from types import SimpleNamespace

import pytest
import torch

from skipgs_plug.commands.view import print_address
from skipgs_plug.trainer import InputError
from skipgs_plug.view import page as module
from skipgs_plug.view.model import Model
from skipgs_plug.view.page import Page, require_address
from skipgs_plug.view.web.server import WebPage


def splats_of(n):
    """Return the raw parameters of n grey Gaussians at the origin."""
    splats = {"means": torch.zeros(n, 3), "quats": torch.ones(n, 4), "scales": torch.zeros(n, 3)}
    return {**splats, "opacities": torch.zeros(n), "sh0": torch.zeros(n, 1, 3), "shN": torch.zeros(n, 15, 3)}


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
    try:
        page.show(splats_of(2), "Iteration 300")
        waiting = threading.Thread(target=page.wait, daemon=True)
        waiting.start()
        waiting.join(10)
        assert not waiting.is_alive() and page.chosen_step == 100
        assert not page._asked.is_set()
    finally:
        page.stop()


def test_the_last_port_being_taken_is_said_before_anything_waits_for_it():
    with socket.create_server(("127.0.0.1", 65535)), pytest.raises(InputError, match=r"taken.* give another --port"):
        Page(None, lambda splats, view: None, port=65535)


@pytest.mark.skipif(not socket.has_ipv6, reason="this system has no IPv6")
def test_an_address_of_ipv6_is_served(capsys):
    model = Model("statue", [], None)
    page = WebPage(model, splats_of(2), lambda splats, view: None, "::1", 18472)
    try:
        print_address(model, "::1", page.port)
        url = re.search(r"http://\S+", capsys.readouterr().out).group()
        assert urllib.request.urlopen(url).status == 200
    finally:
        page.stop()


@pytest.mark.parametrize("host, address", [("0.0.0.0", "192.168.1.7"), ("::", "2001:db8::7")])
def test_a_phone_is_told_an_address_that_it_can_open(host, address, monkeypatch, capsys):
    @contextlib.contextmanager
    def network(family, kind):
        assert kind == socket.SOCK_DGRAM  # so nothing is sent
        assert (family == socket.AF_INET6) == (":" in host)
        yield SimpleNamespace(connect=lambda to: None, getsockname=lambda: (address, 40000))

    monkeypatch.setattr(socket, "socket", network)
    print_address(Model("statue", [], None), host, 8080)
    shown = f"[{address}]" if ":" in address else address
    assert capsys.readouterr().out == f"statue: http://{shown}:8080 (Ctrl-C ends)\n"


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_without_a_network_the_name_of_the_machine_is_told(host, monkeypatch, capsys):
    def fail(*arguments):
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(socket, "socket", fail)
    monkeypatch.setattr(socket, "gethostname", lambda: "studio")
    print_address(Model("statue", [], None), host, 8080)
    assert capsys.readouterr().out == "statue: http://studio:8080 (Ctrl-C ends)\n"


def test_a_port_that_is_taken_is_left_to_the_server_which_takes_the_next():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        require_address("127.0.0.1", taken.getsockname()[1])
