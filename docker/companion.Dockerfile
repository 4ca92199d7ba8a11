# The daemon. Build from the root of the repository: docker build -f docker/companion.Dockerfile -t companion:0.1.0 .
FROM python:3.11.14-slim-bookworm AS build
ENV PIP_CONSTRAINT=/src/constraints.txt PIP_BUILD_CONSTRAINT=/src/constraints.txt \
    PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
# dependencies in a layer of their own; the secret is the builder's pip.conf, where packages come from a private index
COPY pyproject.toml constraints.txt docker/requirements.py ./
ARG EXTRAS=""
RUN --mount=type=secret,id=pip.conf,target=/etc/pip.conf \
    python -m venv --without-pip /opt/companion \
    && python requirements.py ${EXTRAS} > requirements.txt \
    && python -m pip --python /opt/companion/bin/python install -c constraints.txt -r requirements.txt \
    # a quarter of it is never read: tests of the libraries, and the MAVLink dialects that the daemon does not speak
    && find /opt/companion/lib -type d -name tests -prune -exec rm -r {} + \
    && find /opt/companion/lib -path '*/pymavlink/dialects/*' -type f \
        ! -name '__init__*' ! -path '*/v20/*ardupilotmega*' -delete
COPY LICENSE README.md ./
COPY configs configs/
COPY policies policies/
COPY sim_bridge sim_bridge/
COPY companion companion/
RUN --mount=type=secret,id=pip.conf,target=/etc/pip.conf \
    python -m pip --python /opt/companion/bin/python install -c constraints.txt --no-deps .

FROM python:3.11.14-slim-bookworm
ARG REVISION=unknown
LABEL org.opencontainers.image.title="companion" \
      org.opencontainers.image.description="A companion-computer daemon that keeps a drone clear of moving obstacles" \
      org.opencontainers.image.version="0.1.0" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.base.name="docker.io/library/python:3.11.14-slim-bookworm" \
      org.opencontainers.image.revision="${REVISION}"
RUN groupadd --gid 10001 companion \
    && useradd --uid 10001 --gid companion --no-create-home --home-dir /tmp --shell /usr/sbin/nologin companion \
    && install -d -o companion -g companion -m 0750 /var/lib/companion
COPY --from=build /opt/companion /opt/companion
COPY docker/health.py /opt/companion/health.py
COPY configs/default.toml /etc/companion/companion.toml
ENV PATH=/opt/companion/bin:$PATH HOME=/tmp PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
WORKDIR /var/lib/companion
USER 10001:10001
VOLUME ["/var/lib/companion"]
STOPSIGNAL SIGTERM
# alive, vehicle or not; /healthz asks for a vehicle too
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s --retries=3 \
    CMD ["python", "/opt/companion/health.py", "http", "8080", "/livez"]
ENTRYPOINT ["companion"]
CMD ["run", "-c", "/etc/companion/companion.toml", "--set", "http.port=8080", "--set", "log.directory=\"/var/lib/companion\""]
