# sc3d on Debian 12 without CUDA, never built yet:
#   docker build -t sc3d .
# Work in the present folder, which has the same name inside, because a scene links to its photos:
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:$PWD" -w "$PWD" sc3d run PHOTOS SCENE
#   docker run --rm -p 127.0.0.1:8080:8080 -v "$PWD:$PWD" -w "$PWD" sc3d view SCENE --web --host 0.0.0.0
FROM python:3.11-slim-bookworm
RUN apt-get update \
 && apt-get install -y --no-install-recommends libgl1 libegl1 libgomp1 libusb-1.0-0 libvulkan1 mesa-vulkan-drivers \
 && rm -rf /var/lib/apt/lists/*
COPY tools/constraints.txt /tmp/
RUN torch=$(grep -m1 '^torch==' /tmp/constraints.txt) \
 && pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu "$torch"
COPY setup.cfg pyproject.toml README.md LICENSE /src/
COPY sc3d /src/sc3d
RUN pip install --no-cache-dir -c /tmp/constraints.txt "/src[masks,geo,web,cluster]" && rm -r /src /tmp/constraints.txt
# numba keeps compiled kernels here, whoever runs the image
ENV NUMBA_CACHE_DIR=/tmp/numba HOME=/tmp
ENTRYPOINT ["sc3d"]
