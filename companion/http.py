"""The daemon's HTTP server: where the page, metrics and health are read.

It listens on this computer alone unless ``http.host`` says otherwise. A page of another site must not reach it through
the visitor's browser: there is no CORS, a request must call this host by an address or a known name (else a site could
point its own name here, DNS rebinding), and what changes anything or streams checks the origin (`same_origin`).
No handler can end a flight: what one raises is logged and answered with status 500.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
from collections.abc import Awaitable, Callable, Iterable
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler

from companion.config_links import HttpConfig
from companion.errors import ConfigError

log = logging.getLogger("companion")

DEFAULT_PORT = 8080
MAX_BODY_BYTES = 16384
SHUTDOWN_S = 0.5  # an open request is given this long when the daemon ends
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class HttpServer:
    """Serves what was added before ``start``; ``on_stop`` callbacks end what would go on for ever."""

    def __init__(self, config: HttpConfig) -> None:
        self._config = config
        self._known = {"localhost", config.host.lower(), *(name.lower() for name in config.names)}
        self._app = web.Application(middlewares=[self._guard], client_max_size=MAX_BODY_BYTES)
        self._app.on_response_prepare.append(_add_headers)
        self._runner: web.AppRunner | None = None
        self.url = ""  # of the root, once it listens

    def add(self, method: str, path: str, handler: Handler) -> None:
        """Answer ``method`` on ``path`` by ``handler(request) -> response``, a coroutine in the daemon's loop.

        Whatever it computes delays a tick by as much: prepare elsewhere, answer here.
        """
        self._app.router.add_route(method, path, handler)

    def on_stop(self, callback: Callable[[], Awaitable[None]]) -> None:
        """Await ``callback`` when the server ends, before it waits for open requests."""

        async def end(_: web.Application) -> None:
            await callback()

        self._app.on_shutdown.append(end)

    async def start(self) -> None:
        """Listen as configured; an unset port is 8080, or a free one where that is taken.

        Raises:
            ConfigError: one line that names ``http.port`` or ``http.host``.
        """
        config = self._config
        runner = web.AppRunner(self._app, access_log=None, handle_signals=False, shutdown_timeout=SHUTDOWN_S)
        await runner.setup()
        try:
            try:
                port = await _listen(runner, config.host, DEFAULT_PORT if config.port is None else config.port)
            except OSError as error:
                if config.port is not None or error.errno not in (errno.EADDRINUSE, errno.EACCES):
                    raise
                port = await _listen(runner, config.host, 0)
        except OSError as error:
            await runner.cleanup()
            raise _refused(config, error) from None
        self._runner = runner
        self.url = f"http://{_url_host(config.host)}:{port}/"
        log.info("http: %s", self.url)

    async def stop(self) -> None:
        """End every request and close the socket."""
        if self._runner is not None:
            runner, self._runner = self._runner, None
            await runner.cleanup()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if not is_known_host(request.headers.get("Host", ""), self._known):
            return _plain(421, "unknown host name: expected an address of this computer or one of http.names")
        try:
            return await handler(request)
        except web.HTTPException as error:
            return _plain(error.status, error.reason, error.headers.get("Allow"))
        except Exception:
            log.exception("http: %s %s failed", request.method, request.path)
            return _plain(500, "internal error, the daemon's log tells more")


def is_known_host(header: str, known: Iterable[str]) -> bool:
    """Whether a Host header is an address, or one of the names ``known`` (lower case).

    >>> [is_known_host(h, ["localhost"]) for h in ("127.0.0.1:8080", "[::1]:80", "Localhost:1", "evil.test:8080", "")]
    [True, True, True, False, False]
    """
    try:
        name = urlsplit(f"//{header}").hostname or ""
    except ValueError:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name.rstrip(".") in known
    return True


def same_origin(request: web.Request) -> bool:
    """Whether a request comes from a page of this server, or from no page at all (no Origin header)."""
    origin = request.headers.get("Origin")
    if origin is None:
        return True
    return urlsplit(origin).netloc.lower() == request.headers.get("Host", "").lower() != ""


async def _listen(runner: web.AppRunner, host: str, port: int) -> int:
    """The port on which ``runner`` now listens. Raises OSError."""
    site = web.TCPSite(runner, host, port)
    try:
        await site.start()
    except BaseException:
        await site.stop()
        raise
    return int(runner.addresses[0][1])


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    for name, value in HEADERS.items():
        response.headers.setdefault(name, value)


def _plain(status: int, text: str, allow: str | None = None) -> web.Response:
    return web.Response(status=status, text=f"{text}\n", headers={} if allow is None else {"Allow": allow})


def _url_host(host: str) -> str:
    """What a browser on this computer is to call: a wildcard is no destination."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"[{host}]" if ":" in host else host


def _refused(config: HttpConfig, error: OSError) -> ConfigError:
    reason = (error.strerror or str(error)).lower()
    if error.errno in (errno.EADDRINUSE, errno.EACCES):
        return ConfigError(
            f"http.port {config.port}: cannot listen on {config.host} ({reason.rpartition(': ')[2]}), expected a free"
            " port: name another, 0 for any, or set http.enabled = false"
        )
    return ConfigError(f"http.host {config.host}: cannot listen there ({reason}), expected an address of this computer")
