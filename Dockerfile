# raytac on a CPU, or on CUDA with another base image.
#
#   docker build -t raytac .
#   docker run --rm -v raytac-cache:/root/.cache -v "$PWD/runs:/work/runs" raytac press coin
#
#   docker build -t raytac-cuda --build-arg BASE=nvidia/cuda:12.8.1-runtime-ubuntu24.04 --build-arg EXTRAS=gpu,ipc,robots .
#   docker run --rm --gpus all -v raytac-cache:/root/.cache -v "$PWD/runs:/work/runs" raytac-cuda press coin --device cuda
#
# The volume raytac-cache keeps compiled kernels, which take up to a minute, for the next container.
# Ray tracing on CUDA needs OptiX, which the host's driver brings: NVIDIA_DRIVER_CAPABILITIES must contain "graphics".
ARG BASE=ubuntu:24.04
FROM ${BASE}
ARG EXTRAS=ipc,robots

# Dr.Jit needs libatomic1, which no other package brings. EGL draws MuJoCo's pictures without a screen: Mesa's on a CPU, the driver's own
# on CUDA. The last three libraries are for tetrahedra (pyvista) and pictures.
RUN apt-get update \
 && apt-get install --yes --no-install-recommends python3 python3-venv \
      libatomic1 libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0 libgl1 libxrender1 libgomp1 \
 && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/raytac
COPY pyproject.toml README.md LICENSE ./
COPY raytac raytac
COPY ipc ipc
COPY scenes scenes
COPY lights lights
RUN python3 -m venv /opt/venv && /opt/venv/bin/pip install --no-cache-dir ".[${EXTRAS}]"

# Dr.Jit would keep its kernels outside the volume.
ENV PATH=/opt/venv/bin:$PATH MUJOCO_GL=egl NVIDIA_DRIVER_CAPABILITIES=all DRJIT_CACHE_DIR=/root/.cache/drjit
WORKDIR /work
ENTRYPOINT ["raytac"]
CMD ["doctor"]
