"""Who may talk to the viewer: requests to a loopback name, and never from another site's page.

The toolkit below us checks neither `Host` nor `Origin`, so any page the user visits could open a websocket to the
viewer and drive it. Two rules close that: `Host` names this computer (no DNS rebinding), and an `Origin`, which every
browser sends with a websocket, is the origin that the page itself was loaded from.
"""

import ipaddress
from collections.abc import Sequence
from urllib.parse import urlsplit

from carts_core.errors import SettingsError

_LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


def check_loopback(host: str) -> None:
    """Raise `SettingsError` unless `host` is an address of this computer only."""
    if host == "localhost":
        return
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise SettingsError(
            f"The viewer was asked to listen on {host!r}, where other computers could reach it; it has no login. "
            "Use 127.0.0.1, and from another computer forward the port: ssh -L 8080:127.0.0.1:8080 THIS_COMPUTER"
        )


def refusal(hosts: Sequence[str], origins: Sequence[str]) -> str | None:
    """Why a request must not be answered; None when it may.

    Args:
        hosts: Every `Host` header of the request; there must be exactly one.
        origins: Every `Origin` header; programs other than browsers send none.
    """
    if len(hosts) != 1 or _hostname(f"//{hosts[0]}") not in _LOOPBACK_NAMES:
        return f"The viewer answers on 127.0.0.1 and localhost only, and was asked for {', '.join(hosts)!r}."
    for origin in origins:
        if origin != f"http://{hosts[0]}":
            return f"The viewer answers its own page only, and this request came from {origin!r}."
    return None


def _hostname(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None
