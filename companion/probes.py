"""`/metrics`, `/healthz` and `/livez` on the daemon's HTTP server. Answered in its loop, from what is in memory."""

from __future__ import annotations

from aiohttp import web

from companion.http import HttpServer
from companion.prometheus import CONTENT_TYPE, Exposition
from companion.vitals import Vitals


def add_probes(server: HttpServer, vitals: Vitals) -> None:
    """Answer what Prometheus, containers and load balancers ask."""
    exposition = Exposition(vitals.reading)

    async def metrics(_: web.Request) -> web.Response:
        return web.Response(body=exposition.text(), headers={"Content-Type": CONTENT_TYPE})

    async def healthz(_: web.Request) -> web.Response:
        status, body = vitals.health()
        return web.json_response(body, status=status)

    async def livez(_: web.Request) -> web.Response:
        status, body = vitals.health(live_only=True)
        return web.json_response(body, status=status)

    server.add("GET", "/metrics", metrics)
    server.add("GET", "/healthz", healthz)
    server.add("GET", "/livez", livez)
