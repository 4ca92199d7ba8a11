"""Byte transports named by MAVSDK-style URLs: UDP, TCP and serial on asyncio.

    udpin://HOST:PORT      listen; answers go to every peer heard in the last 5 s
    udpout://HOST:PORT     send there
    tcpin://HOST:PORT      listen for one client; a new one replaces the old
    tcpout://HOST:PORT     connect, and again after a loss
    serial:///dev/X:BAUD   a serial port, opened again after a loss

Nothing is queued here beyond the kernel's send buffer, a few kilobytes of it on TCP: a setpoint that cannot leave now
is stale, so it is dropped and counted. What the receive buffer of a TCP peer has taken cannot be called back.
"""

from __future__ import annotations

from companion.clock import Clock, SystemClock
from companion.errors import ConfigError
from companion.link.serial import SerialPort
from companion.link.tcp import TcpClient, TcpServer
from companion.link.udp import open_udp
from companion.link.url import OnBytes, Transport, parse_url

__all__ = ["OnBytes", "Transport", "open_transport", "parse_url"]


async def open_transport(
    url: str, on_bytes: OnBytes, *, clock: Clock | None = None, key: str = "mavlink.url"
) -> Transport:
    """Open the link and call ``on_bytes`` with whatever arrives, in the loop's thread.

    ``key`` is where the configuration has the URL, for errors.

    Raises:
        ConfigError: a bad URL, a port in use, an unknown host, a device that cannot be opened; names the URL.
    """
    parsed = parse_url(url, key)
    clock = clock or SystemClock()
    try:
        match parsed.scheme:
            case "udpin" | "udpout":
                return await open_udp(parsed, on_bytes, clock)
            case "tcpin":
                server = TcpServer(on_bytes)
                await server.listen(parsed)
                return server
            case "tcpout":
                return TcpClient(parsed, on_bytes, clock)
            case _:
                return SerialPort(parsed, on_bytes, clock)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"{key} {url}: cannot be opened ({reason}), expected a free port or device") from None
