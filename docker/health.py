"""Is the process of this container well? Exit status 0 it is, 1 it is not, and one line says why.

    python health.py http 8080 /livez     the daemon answers 200 there (/healthz: and has a vehicle that it can fly)
    python health.py mavlink 14550        somebody sends MAVLink to this UDP port of the loopback, as the simulator does

The images have neither curl nor a shell that a check would need; this uses the standard library alone.
"""

from __future__ import annotations

import http.client
import socket
import sys

TIMEOUT_S = 2.5  # a heartbeat comes once a second
_MAVLINK = (b"\xfd", b"\xfe")  # the first byte of a packet, version 2 and 1


def http_problem(port: int, path: str) -> str | None:
    """Why ``path`` is not answered with status 200, None where it is."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        body = response.read(300).decode(errors="replace").strip()
    except (OSError, http.client.HTTPException) as error:
        return f"http://127.0.0.1:{port}{path}: no answer ({error})"
    finally:
        connection.close()
    return None if response.status == 200 else f"http://127.0.0.1:{port}{path}: status {response.status}: {body}"


def mavlink_problem(port: int) -> str | None:
    """Why no MAVLink was received on ``port``, None where it was."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.settimeout(TIMEOUT_S)
        try:
            listener.bind(("127.0.0.1", port))
            data = listener.recv(65535)
        except OSError as error:
            return f"UDP port {port}: no MAVLink ({error})"
    return None if data[:1] in _MAVLINK else f"UDP port {port}: not MAVLink"


def main(words: list[str]) -> int:
    """Run the check that ``words`` names."""
    match words:
        case ["http", port, path]:
            problem = http_problem(int(port), path)
        case ["mavlink", port]:
            problem = mavlink_problem(int(port))
        case _:
            problem = "health.py: expected http PORT PATH, or mavlink PORT"
    print(problem or "ok")
    return 0 if problem is None else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
