# CaRTS for a CPU: `docker build -t carts .`, then see docs/howto/install.md.
FROM python:3.12-slim@sha256:78387bc3881b8273120a12ebe6c1ab22b018ccc2c9adf565ae1ac9b536e184ea
ENV PYTHONUNBUFFERED=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /opt/carts

# Packages by their hashes, then the CPU build of torch by its version, in layers that a change of the code leaves alone.
COPY constraints.txt requirements.lock ./
RUN pip install --no-cache-dir --no-deps --require-hashes -r requirements.lock
RUN pip install --no-cache-dir --no-deps --index-url https://download.pytorch.org/whl/cpu -c constraints.txt torch

COPY pyproject.toml README.md LICENSE ./
COPY carts_core carts_core
COPY carts_viewer carts_viewer
COPY static static
COPY sample_data sample_data
RUN pip install --no-cache-dir --no-deps --no-build-isolation .

# Nobody needs rights to view a recording. Projects and caches are kept in the volume.
RUN useradd --create-home --uid 1000 carts && mkdir /data && chown carts /data
USER carts
ENV CARTS_DATA=/data CARTS_CACHE=/data/cache NUMBA_CACHE_DIR=/data/cache/numba
WORKDIR /data
VOLUME /data
EXPOSE 8080

# All addresses of the container, or Docker could not forward the port. So a token is asked for, which is printed.
CMD ["carts", "view", "--host", "0.0.0.0", "--port", "8080"]
