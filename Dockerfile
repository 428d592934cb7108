# By digest: what is built is what was tested. A newer one: docker buildx imagetools inspect python:3.12-slim
ARG BASE=python:3.12-slim@sha256:78387bc3881b8273120a12ebe6c1ab22b018ccc2c9adf565ae1ac9b536e184ea
FROM ${BASE} AS wheel
WORKDIR /opt/checkout
COPY deploy/build.lock deploy/build.lock
RUN python3 -m venv /opt/build \
    && /opt/build/bin/pip install --no-cache-dir --require-hashes -r deploy/build.lock
COPY pyproject.toml build_backend.py constraints.txt MANIFEST.in README.md LICENSE ./
# the manual links into the examples
COPY examples examples
COPY docs docs
COPY service service
COPY pyrcal pyrcal
COPY check_rtc check_rtc
COPY sim_rtc sim_rtc
COPY cacao_bridge cacao_bridge
# The build context has no git: docker build --build-arg COMMIT=$(git describe --always --dirty=-modified) .
ARG COMMIT=""
RUN PYRCAL_COMMIT="$COMMIT" /opt/build/bin/pip wheel --no-deps --no-build-isolation --wheel-dir /opt/wheels .

FROM ${BASE}
COPY deploy/requirements.lock /opt/requirements.lock
COPY --from=wheel /opt/wheels /opt/wheels
RUN python3 -m venv /opt/pyrcal \
    && /opt/pyrcal/bin/pip install --no-cache-dir --require-hashes -r /opt/requirements.lock \
    && /opt/pyrcal/bin/pip install --no-cache-dir --no-deps --no-index /opt/wheels/*.whl \
    && useradd --system --uid 10001 --user-group --create-home --home-dir /var/lib/pyrcal pyrcal

# Inside a container loopback reaches nobody: listen on all its interfaces and publish what you want.
# The link to the RTC is open to nobody without a certificate: pyrcal certificates new makes them.
ENV PATH=/opt/pyrcal/bin:/usr/local/bin:/usr/bin:/bin \
    PYTHONDONTWRITEBYTECODE=1 \
    PYRCAL_API__HOST=0.0.0.0 \
    PYRCAL_API__PORT=8080 \
    PYRCAL_ZENOH__LISTEN='["tls/0.0.0.0:7447"]' \
    PYRCAL_ZENOH__TLS='{ ca = "/var/lib/pyrcal/tls/ca.pem", certificate = "/var/lib/pyrcal/tls/service.pem", key = "/var/lib/pyrcal/tls/service-key.pem" }' \
    PYRCAL_SERVICE__DATA_DIR=/var/lib/pyrcal \
    PYRCAL_SERVICE__CACHE_DIR=/var/lib/pyrcal/cache

# by number, for whoever asks for a user that is not root
USER 10001:10001
WORKDIR /var/lib/pyrcal
VOLUME /var/lib/pyrcal
EXPOSE 8080 7447

# 503, and unhealthy, once the service lives and stands still; without an RTC it is well.
HEALTHCHECK --interval=10s --timeout=5s --start-period=120s --retries=3 \
    CMD ["python3", "-c", "import os, urllib.request as u; u.urlopen(f\"http://127.0.0.1:{os.environ['PYRCAL_API__PORT']}/healthz\", timeout=4)"]

ENTRYPOINT ["pyrcal"]
CMD ["run"]
