# CPU image of CaRTS: `docker build -t carts .`; see docs/howto/install.md.
FROM python:3.12-slim@sha256:78387bc3881b8273120a12ebe6c1ab22b018ccc2c9adf565ae1ac9b536e184ea
ENV PYTHONUNBUFFERED=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /opt/carts

# Packages pinned by hash, then the CPU build of torch pinned by version, in layers that do not depend on the code.
COPY constraints.txt requirements.lock ./
RUN pip install --no-cache-dir --no-deps --require-hashes -r requirements.lock
RUN pip install --no-cache-dir --no-deps --index-url https://download.pytorch.org/whl/cpu -c constraints.txt torch

COPY pyproject.toml README.md LICENSE ./
COPY carts_core carts_core
COPY carts_viewer carts_viewer
COPY static static
COPY sample_data sample_data
RUN pip install --no-cache-dir --no-deps --no-build-isolation .

# Unprivileged user. Projects and caches are stored in the volume.
RUN useradd --create-home --uid 1000 carts && mkdir /data && chown carts /data
USER carts
ENV CARTS_DATA=/data CARTS_CACHE=/data/cache NUMBA_CACHE_DIR=/data/cache/numba
WORKDIR /data
VOLUME /data
EXPOSE 8080

# Port forwarding requires listening on all addresses of the container; access then requires the printed token.
CMD ["carts", "view", "--host", "0.0.0.0", "--port", "8080"]
