# The simulated vehicle, and the operator who flies it. x86-64: elsewhere PyBullet has no wheel and wants a compiler.
# Build from the root of the repository: docker build -f docker/simulator.Dockerfile -t companion-simulator:0.1.0 .
FROM python:3.11.14-slim-bookworm AS build
ENV PIP_CONSTRAINT=/src/constraints.txt PIP_BUILD_CONSTRAINT=/src/constraints.txt \
    PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY pyproject.toml constraints.txt docker/requirements.py ./
RUN --mount=type=secret,id=pip.conf,target=/etc/pip.conf \
    python -m venv --without-pip /opt/companion \
    && python requirements.py sim > requirements.txt \
    && python -m pip --python /opt/companion/bin/python install --only-binary pybullet -c constraints.txt -r requirements.txt
COPY LICENSE README.md ./
COPY configs configs/
COPY policies policies/
COPY companion companion/
COPY sim_bridge sim_bridge/
RUN --mount=type=secret,id=pip.conf,target=/etc/pip.conf \
    python -m pip --python /opt/companion/bin/python install -c constraints.txt --no-deps .

FROM python:3.11.14-slim-bookworm
ARG REVISION=unknown
LABEL org.opencontainers.image.title="companion-simulator" \
      org.opencontainers.image.description="A PyBullet Crazyflie behind a PX4-style MAVLink autopilot, among moving obstacles" \
      org.opencontainers.image.version="0.1.0" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.base.name="docker.io/library/python:3.11.14-slim-bookworm" \
      org.opencontainers.image.revision="${REVISION}"
RUN groupadd --gid 10001 companion \
    && useradd --uid 10001 --gid companion --no-create-home --home-dir /tmp --shell /usr/sbin/nologin companion \
    && install -d -o companion -g companion -m 0750 /var/lib/companion
COPY --from=build /opt/companion /opt/companion
COPY docker/health.py /opt/companion/health.py
ENV PATH=/opt/companion/bin:$PATH HOME=/tmp PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
WORKDIR /var/lib/companion
USER 10001:10001
STOPSIGNAL SIGTERM
# the simulator sends to this port of the loopback whether somebody listens or not
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s --retries=3 \
    CMD ["python", "/opt/companion/health.py", "mavlink", "14550"]
ENTRYPOINT ["sim-bridge"]
CMD ["run", "--scenario", "demo", "--onboard-bind", "0.0.0.0:14580", "--gcs-bind", "0.0.0.0:18570", "--zenoh-listen", "tcp/0.0.0.0:7447"]
