# CaRTS for a CPU: `docker build -t carts .`, then see docs/howto/install.md.
FROM python:3.12-slim
ENV PYTHONUNBUFFERED=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /opt/carts

# torch first and by itself: the CPU build, and a layer that a change of the code leaves alone.
COPY constraints.txt ./
RUN pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu -c constraints.txt torch

COPY pyproject.toml README.md LICENSE ./
COPY carts_core carts_core
COPY carts_viewer carts_viewer
COPY static static
COPY sample_data sample_data
RUN pip install --no-cache-dir -c constraints.txt .

# Nobody needs rights to view a recording. Projects and caches are kept in the volume.
RUN useradd --create-home --uid 1000 carts && mkdir /data && chown carts /data
USER carts
ENV CARTS_DATA=/data CARTS_CACHE=/data/cache NUMBA_CACHE_DIR=/data/cache/numba
WORKDIR /data
VOLUME /data
EXPOSE 8080

# All addresses of the container, or Docker could not forward the port. So a token is asked for, which is printed.
CMD ["carts", "view", "--host", "0.0.0.0", "--port", "8080"]
