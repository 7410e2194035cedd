"""Passwords in addresses of servers and databases: removed where text comes in, restored to open a connection.

In between, addresses have no passwords, so that no output can contain one.
"""

import re
from collections.abc import Mapping
from typing import TypeVar
from urllib.parse import quote, quote_plus, unquote

Value = TypeVar("Value")

_SCHEME = r"[A-Za-z][A-Za-z0-9+.-]*://"
_ADDRESS = re.compile(rf"({_SCHEME})((?:(?![\s,\['\"]{_SCHEME}).)*)", re.DOTALL)
_PARAMETER = re.compile(r"(?<=[?&])(?:password|passwd|pwd|token|secret)=([^&\s'\"]*)&?", re.IGNORECASE)
_USER_INFO = re.compile(r"(?<=://)[^/\s]*@")

_whole: dict[str, str] = {}
"""Original addresses, by the same address without its password."""
_secrets: set[str] = set()
"""Every spelling of the passwords that were removed."""


def without_passwords(value: Value) -> Value:
    """Return a text, or all texts in a mapping or list, without the passwords of addresses.

    A server's user is removed as well (`http://host:5000`), a database's stays (`postgresql://user@host/name`): what is
    left works wherever the password comes from the environment. `with_password` puts it back.
    """
    if isinstance(value, str):
        return _ADDRESS.sub(_without_password, value) if "://" in value else value  # type: ignore[return-value]
    if isinstance(value, Mapping):
        return {key: without_passwords(item) for key, item in value.items()}  # type: ignore[return-value]
    if isinstance(value, list):
        return [without_passwords(item) for item in value]  # type: ignore[return-value]
    return value


def with_password(address: str) -> str:
    """Return an address with the password given to this process or its parent."""
    return _whole.get(address, address)


def taken_out() -> dict[str, str]:
    """Return the addresses that had a password, for `take_over` in a worker."""
    return dict(_whole)


def take_over(addresses: Mapping[str, str]) -> None:
    """Adopt the passwords that another process has removed."""
    for address in addresses.values():
        without_passwords(address)


def redact(text: str) -> str:
    """Return a library's message without known passwords, and without what looks like one in an address."""
    for secret in sorted(_secrets, key=len, reverse=True):
        text = text.replace(secret, "***")
    return _PARAMETER.sub("", _USER_INFO.sub("***@", text))


def _without_password(match: re.Match[str]) -> str:
    scheme, rest = match.groups()
    # Quotes and brackets of the shell or of Hydra's grammar are not part of the address.
    address = rest.rstrip("'\"]},")
    around = rest[len(address) :]
    user, password, place = _parts(address)
    secrets = [password, *_PARAMETER.findall(place)]
    place = _PARAMETER.sub("", place).rstrip("?&") if _PARAMETER.search(place) else place
    is_server = scheme.lower() in ("http://", "https://")
    if is_server and not password:
        secrets.append(user)  # a token
    plain = scheme + (f"{user}@" if user and not is_server else "") + place
    if plain != scheme + address:
        _whole[plain] = scheme + address
        for secret in filter(None, secrets):
            decoded = unquote(secret)
            _secrets.update((secret, decoded, quote(decoded, safe=""), quote_plus(decoded)))
    return plain + around


def _parts(address: str) -> tuple[str, str, str]:
    """Return user, password and what follows the @ of an address without its scheme."""
    host = re.split(r"[/?#]", address, maxsplit=1)[0]
    _, colon, port = host.rpartition(":")
    if "@" in host:
        length = host.rindex("@")
    elif colon and not port.isdigit() and "@" in address:
        length = address.rindex("@")  # a password with a slash that is not written as %2F
    else:
        return "", "", address
    user, _, password = address[:length].partition(":")
    return user, password, address[length + 1 :]
