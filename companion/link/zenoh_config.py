"""Zenoh settings: from a stock Zenoh configuration file, from the short form of `[zenoh]`, or both.

What the short form sets overrides the file. What neither sets is not Zenoh's default where that reaches off the
host: nothing is scouted by multicast, nothing is gossiped, nothing listens. Zenoh reads certificates only when a
link is made, and a peer keeps trying in silence; here every file is read and checked before the session opens.
"""

from __future__ import annotations

import json
import os
import re
import ssl
from pathlib import Path
from typing import Any

import zenoh

from companion.config_links import ZenohConfig
from companion.errors import ConfigError
from companion.link.inbox import MAX_PAYLOAD_BYTES
from companion.link.secret_file import read_secret

MAX_MESSAGE_BYTES = 2 * MAX_PAYLOAD_BYTES  # a reassembled message; Zenoh's default of 1 GiB is a way to fill memory

_TLS = "transport/link/tls"
_USER = "transport/auth/usrpwd"
_RX_SIZE = "transport/link/rx/max_message_size"
_ENDPOINTS = "expected endpoints such as tcp/127.0.0.1:7447"


def open_session(config: ZenohConfig) -> zenoh.Session:
    """A session as configured. Nothing listens and nothing is scouted beyond what the configuration names.

    Raises:
        ConfigError: a file that cannot be read or is wrong, a secret that others may read, an endpoint that cannot be
            parsed, bound or (client only) reached; names the key or the file.
    """
    settings = session_settings(config)
    # RUST_LOG=warn shows whom a link refuses and why; silent without it
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        mode, listen, connect = (settings.get_json(key) for key in ("mode", "listen/endpoints", "connect/endpoints"))
        raise ConfigError(
            f"zenoh: cannot open mode {json.loads(mode)}, listen {_spaced(listen)}, connect {_spaced(connect)}:"
            f" {_reason(error)}"
        ) from None


def session_settings(config: ZenohConfig) -> zenoh.Config:
    """Zenoh's own configuration for ``config``, with every file that it names read and checked.

    Raises:
        ConfigError: as `open_session`.
    """
    settings = _Settings(config.config_file)
    settings.set("mode", config.mode or settings.get("mode") or "peer", "zenoh.mode: expected peer, client or router")
    multicast = config.multicast_scouting
    if multicast is None:
        multicast = settings.get("scouting/multicast/enabled") is True
    settings.set("scouting/multicast/enabled", multicast)
    settings.set("scouting/gossip/enabled", settings.get("scouting/gossip/enabled") or False)
    if config.connect:
        settings.set("connect/endpoints", config.connect, f"zenoh.connect: {_ENDPOINTS}")
    if config.listen or settings.is_default("listen/endpoints"):
        settings.set("listen/endpoints", config.listen, f"zenoh.listen: {_ENDPOINTS}")
    if settings.get("mode") != "router" and settings.is_default(_RX_SIZE):
        settings.set(_RX_SIZE, MAX_MESSAGE_BYTES)  # a router may carry what is larger for others
    _insert_tls(settings, config)
    _insert_user(settings, config)
    _check_tls(settings)
    _check_user(settings, config)
    _check_client(settings)
    return settings.zenoh


class _Settings:
    """A Zenoh configuration that remembers where each value came from."""

    def __init__(self, file: str | None) -> None:
        self.file = file
        self.zenoh = zenoh.Config() if file is None else _from_file(file)
        self._default = zenoh.Config()
        self._names: dict[str, str] = {}

    def get(self, key: str) -> Any:
        return json.loads(self.zenoh.get_json(key))

    def is_default(self, key: str) -> bool:
        """Whether ``key`` has Zenoh's own default; a file that writes the default down cannot be told from none."""
        return bool(self.zenoh.get_json(key) == self._default.get_json(key))

    def set(self, key: str, value: object, expectation: str = "", *, name: str = "") -> None:
        """Set ``key``; ``expectation`` is the error text, ``name`` the key of the short form that it came from."""
        try:
            self.zenoh.insert_json5(key, json.dumps(value))
        except zenoh.ZError:
            raise ConfigError(f"{expectation or 'zenoh.' + key}, got {json.dumps(value)}") from None
        self._names[key] = name

    def name(self, key: str) -> str:
        """Where the value of ``key`` was written, for an error."""
        return self._names.get(key) or f"{self.file}: {key.replace('/', '.')}"


def _from_file(file: str) -> zenoh.Config:
    if not os.access(file, os.R_OK):
        reason = "no permission" if Path(file).exists() else "no such file"
        raise ConfigError(f"zenoh.config_file: {file}: cannot be read ({reason}), expected a Zenoh configuration")
    try:
        return zenoh.Config.from_file(file)
    except zenoh.ZError as error:
        raise ConfigError(f"zenoh.config_file: {file}: {_reason(error)}") from None


def _insert_tls(settings: _Settings, config: ZenohConfig) -> None:
    tls = config.tls
    if (tls.certificate is None) != (tls.private_key is None):
        raise ConfigError("zenoh.tls: expected certificate and private_key together, got only one of them")
    for name, value, keys in (
        ("ca", tls.ca, ("root_ca_certificate",)),
        ("certificate", tls.certificate, ("listen_certificate", "connect_certificate")),
        ("private_key", tls.private_key, ("listen_private_key", "connect_private_key")),
        ("mutual", tls.mutual, ("enable_mtls",)),
    ):
        for key in keys if value is not None else ():
            settings.set(f"{_TLS}/{key}", value, name=f"zenoh.tls.{name}")


def _insert_user(settings: _Settings, config: ZenohConfig) -> None:
    if (config.user is None) != (config.password_file is None):
        raise ConfigError("zenoh.user: expected user and password_file together, got only one of them")
    values = settings.get(_USER)
    if values["password"] is not None and settings.file is not None:
        read_secret(settings.file, f"zenoh.config_file: {settings.file}: {_USER.replace('/', '.')}.password")
    if config.user is not None and config.password_file is not None:
        name = f"zenoh.password_file: {config.password_file}"
        password = read_secret(config.password_file, name).removesuffix("\n").removesuffix("\r")
        if not password or "\n" in password:
            raise ConfigError(f"{name}: expected one line, the password")
        values |= {"user": config.user, "password": password}
    if config.users_file is not None:
        values["dictionary_file"] = config.users_file
    settings.zenoh.insert_json5(_USER, json.dumps(values))  # whole: a user alone is refused
    if config.users_file is not None:
        settings.set(f"{_USER}/dictionary_file", config.users_file, name="zenoh.users_file")


def _check_tls(settings: _Settings) -> None:
    """Read every file of `transport.link.tls` as a link would, and demand that private keys are private."""
    tls = settings.get(_TLS)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if tls["root_ca_certificate"] is not None:
        name, path = settings.name(f"{_TLS}/root_ca_certificate"), tls["root_ca_certificate"]
        try:
            context.load_verify_locations(cafile=path)
        except (OSError, ssl.SSLError) as error:
            raise ConfigError(f"{name}: {path}: {_ssl_reason(error)}, expected CA certificates in PEM") from None
    elif tls["enable_mtls"] and settings.file is None:  # a file may hold the CA itself, which Zenoh does not show
        raise ConfigError("zenoh.tls.mutual: expected zenoh.tls.ca, to check the others against")
    for side in ("listen", "connect"):
        key, certificate = tls[f"{side}_private_key"], tls[f"{side}_certificate"]
        if key is None or certificate is None:
            continue
        read_secret(key, f"{settings.name(f'{_TLS}/{side}_private_key')}: {key}")
        name = settings.name(f"{_TLS}/{side}_certificate")
        try:
            context.load_cert_chain(certificate, key, password=lambda: "")  # "": never ask at the terminal
        except (OSError, ssl.SSLError) as error:
            raise ConfigError(
                f"{name}: {certificate}: {_ssl_reason(error)}, expected a certificate in PEM and its private key {key}"
            ) from None


def _check_user(settings: _Settings, config: ZenohConfig) -> None:
    values = settings.get(_USER)
    users = values["dictionary_file"]
    if users is not None:
        name = f"{settings.name(f'{_USER}/dictionary_file')}: {users}"
        for number, line in enumerate(read_secret(users, name).splitlines(), start=1):
            if not re.fullmatch(r"[^:]+:.+|\s*", line):
                raise ConfigError(f"{name}: line {number}: expected user:password")
    elif values["user"] is not None and settings.get("listen/endpoints"):
        raise ConfigError("zenoh.users_file: expected where zenoh.listen and zenoh.user are set: else all are refused")


def _check_client(settings: _Settings) -> None:
    timeout = settings.get("connect/timeout_ms")
    patience = timeout.get("client") if isinstance(timeout, dict) else timeout
    if settings.get("mode") == "client" and patience is not None and patience < 0:
        raise ConfigError(
            f"zenoh.config_file: {settings.file}: connect.timeout_ms: expected at least 0 for a client"
            " (it would wait for its router without end, deaf to signals; a peer waits in the background)"
        )


def _ssl_reason(error: OSError) -> str:
    """``[X509] PEM lib`` and the like in words."""
    if isinstance(error, ssl.SSLError):
        return {
            "KEY_VALUES_MISMATCH": "the certificate is not that of the key",
            "NO_CERTIFICATE_OR_CRL_FOUND": "holds no certificate",
        }.get(error.reason or "", "not what it should be")
    return f"cannot be read ({error.strerror})"


def _reason(error: zenoh.ZError) -> str:
    """Zenoh's complaint in one line, without where in its own source it was raised."""
    text = re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error)).rstrip()
    if text.startswith("Invalid configuration"):  # followed by the whole configuration, passwords included
        return "not a valid Zenoh configuration (a user and its password go together)"
    if found := re.search(r'Message \{ msg: "(.*)", location: (?:Some\(Location \{ line: (\d+))?', text, re.S):
        what, line = found.group(1).replace('\\"', '"'), found.group(2)
    elif found := re.search(r"--> (\d+):\d+.*= (expected .*)", text, re.S):  # not JSON5
        line, what = found.groups()
    else:
        line, what = None, text
    at = "" if line is None else f"line {line}: "
    return at + " ".join(what.split())


def _spaced(text: str) -> str:
    return json.dumps(json.loads(text))
