# raytac on a CPU, or on CUDA with another base image.
#
#   docker build -t raytac .
#   docker run --rm -v "$PWD/runs:/work/runs" raytac press coin
#
#   docker build -t raytac-cuda --build-arg BASE=nvidia/cuda:12.8.1-runtime-ubuntu24.04 --build-arg EXTRAS=gpu,ipc,robots .
#   docker run --rm --gpus all -e NVIDIA_DRIVER_CAPABILITIES=all -v "$PWD/runs:/work/runs" raytac-cuda press coin --device cuda
#
# Ray tracing on CUDA needs OptiX, which the host's driver brings: NVIDIA_DRIVER_CAPABILITIES must contain "graphics".
ARG BASE=ubuntu:24.04
FROM ${BASE}
ARG EXTRAS=ipc,robots

# libosmesa6 draws MuJoCo's pictures without a screen; the other libraries are for tetrahedra (pyvista) and pictures.
RUN apt-get update \
 && apt-get install --yes --no-install-recommends python3 python3-venv libosmesa6 libgl1 libxrender1 libgomp1 \
 && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/raytac
COPY pyproject.toml README.md LICENSE ./
COPY raytac raytac
COPY ipc ipc
COPY scenes scenes
COPY lights lights
RUN python3 -m venv /opt/venv && /opt/venv/bin/pip install --no-cache-dir ".[${EXTRAS}]"

ENV PATH=/opt/venv/bin:$PATH MUJOCO_GL=osmesa NVIDIA_DRIVER_CAPABILITIES=all
WORKDIR /work
ENTRYPOINT ["raytac"]
CMD ["doctor"]
