ARG BASE=python:3.12-slim
FROM ${BASE} AS manual
WORKDIR /opt
COPY constraints.txt ./
RUN pip install --no-cache-dir -c constraints.txt sphinx myst-parser
# the manual links into these
COPY examples examples
COPY sim_rtc sim_rtc
COPY docs docs
RUN python -m sphinx -q docs manual

FROM ${BASE}

WORKDIR /opt/pyrcal
COPY pyproject.toml build_backend.py constraints.txt README.md LICENSE ./
COPY docs/openapi.json docs/openapi.json
COPY service service
COPY pyrcal pyrcal
COPY --from=manual /opt/manual service/web/manual
COPY check_rtc check_rtc
COPY sim_rtc sim_rtc
COPY cacao_bridge cacao_bridge
COPY studies studies
RUN pip install --no-cache-dir -c constraints.txt . \
    && useradd --system --create-home --home-dir /var/lib/pyrcal pyrcal

# Inside a container loopback reaches nobody: listen on all its interfaces and publish what you want.
# The link to the RTC is open to nobody without a certificate: pyrcal certificates new makes them.
ENV PYRCAL_API__HOST=0.0.0.0 \
    PYRCAL_API__PORT=8080 \
    PYRCAL_ZENOH__LISTEN='["tls/0.0.0.0:7447"]' \
    PYRCAL_ZENOH__TLS='{ ca = "/var/lib/pyrcal/tls/ca.pem", certificate = "/var/lib/pyrcal/tls/service.pem", key = "/var/lib/pyrcal/tls/service-key.pem" }' \
    PYRCAL_SERVICE__DATA_DIR=/var/lib/pyrcal \
    PYRCAL_SERVICE__CACHE_DIR=/var/lib/pyrcal/cache

USER pyrcal
WORKDIR /var/lib/pyrcal
VOLUME /var/lib/pyrcal
EXPOSE 8080 7447

HEALTHCHECK --interval=10s --timeout=3s --start-period=60s \
    CMD ["python", "-c", "import os, urllib.request as u; u.urlopen(f\"http://127.0.0.1:{os.environ['PYRCAL_API__PORT']}/healthz\", timeout=2)"]

ENTRYPOINT ["pyrcal"]
CMD ["run"]
