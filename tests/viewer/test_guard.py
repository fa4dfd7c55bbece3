"""Who may talk to the viewer."""

import pytest

from carts_core.errors import SettingsError
from carts_viewer.guard import check_loopback, refusal


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080", "127.0.0.1:9000"])
def test_this_computers_own_names_are_answered(host: str) -> None:
    assert refusal([host], []) is None
    assert refusal([host], [f"http://{host}"]) is None


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "", "192.168.0.7:8080", "["]
)
def test_a_foreign_host_name_is_refused_so_that_dns_rebinding_does_not_work(host: str) -> None:
    assert "was asked for" in (refusal([host], []) or "")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "https://localhost:8080", "http://localhost:3000", "null", "http://localhost"]
)
def test_another_sites_page_is_refused_even_on_this_computer(origin: str) -> None:
    assert "own page only" in (refusal(["localhost:8080"], [origin]) or "")


def test_a_request_with_two_hosts_or_none_is_refused() -> None:
    assert refusal(["localhost:8080", "evil.example"], []) is not None
    assert refusal([], []) is not None


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_addresses_may_be_listened_on(host: str) -> None:
    check_loopback(host)


@pytest.mark.parametrize("host", [".".join("0000"), "192.168.0.7", "::", "example.org", ""])
def test_listening_for_other_computers_is_refused_with_a_way_to_reach_the_viewer(host: str) -> None:
    with pytest.raises(SettingsError, match="ssh -L"):
        check_loopback(host)
