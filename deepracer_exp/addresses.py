"""Passwords in addresses of servers and databases: taken out where text comes in, put back where one connects.

Between the two the program knows addresses without passwords only, so that nothing it prints or writes can hold one.
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
"""Addresses as they were given, by what is left of them without password."""
_secrets: set[str] = set()
"""Every spelling of the passwords that were taken out."""


def without_passwords(value: Value) -> Value:
    """Return a text without the passwords of the addresses in it; mappings and lists with all texts in them.

    A server's user goes as well (`http://host:5000`), a database's stays (`postgresql://user@host/name`): what is left
    works wherever the password comes from the environment. `with_password` knows what was taken out.
    """
    if isinstance(value, str):
        return _ADDRESS.sub(_without_password, value) if "://" in value else value  # type: ignore[return-value]
    if isinstance(value, Mapping):
        return {key: without_passwords(item) for key, item in value.items()}  # type: ignore[return-value]
    if isinstance(value, list):
        return [without_passwords(item) for item in value]  # type: ignore[return-value]
    return value


def with_password(address: str) -> str:
    """Return an address as it was given to this process, or to the one that it works for."""
    return _whole.get(address, address)


def taken_out() -> dict[str, str]:
    """Return the addresses that had a password, for `take_over` in a process that works for this one."""
    return dict(_whole)


def take_over(addresses: Mapping[str, str]) -> None:
    """Know the passwords that another process has taken out."""
    for address in addresses.values():
        without_passwords(address)


def redact(text: str) -> str:
    """Return what a library said, without passwords: neither known ones nor what looks like one in an address."""
    for secret in sorted(_secrets, key=len, reverse=True):
        text = text.replace(secret, "***")
    return _PARAMETER.sub("", _USER_INFO.sub("***@", text))


def _without_password(found: re.Match[str]) -> str:
    scheme, rest = found.groups()
    # What the shell or Hydra's grammar has around an address is no part of it.
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
