"""Where the page in the browser may listen."""

import socket

import pytest

from skipgs_plug.trainer import InputError
from skipgs_plug.view.page import Page, require_address


@pytest.mark.parametrize(
    "host, port, complaint",
    [
        ("127.0.0.1", 65536, "port=65536 is not in 1..65535"),
        ("127.0.0.1", 0, "port=0 is not in 1..65535"),
        ("nowhere.invalid", 8080, r"Cannot listen on nowhere.invalid:8080 \("),
        ("203.0.113.1", 8080, r"Cannot listen on 203.0.113.1:8080 \("),  # of nobody: reserved for documents
    ],
)
def test_an_address_that_cannot_be_is_refused_before_anything_waits_for_it(host, port, complaint):
    with pytest.raises(InputError, match=complaint):
        Page(None, lambda splats, view: None, host=host, port=port)


def test_a_port_that_is_taken_is_left_to_the_server_which_takes_the_next():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        require_address("127.0.0.1", taken.getsockname()[1])
