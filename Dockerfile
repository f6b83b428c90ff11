# sparklod with all kernels compiled, for every processor of a level:
#
#   docker build -t sparklod .                          # x86-64-v3: processors with AVX2, since about 2013 to 2015
#   docker build -t sparklod --build-arg CPU=x86-64 .   # any; on arm64, CPU has no effect
#   docker build -t sparklod:cuda --build-arg EXTRAS=cuda .  # with what draws on NVIDIA cards
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" sparklod build-lod scene.ply
#
# What takes long is container/install, which runs outside of containers, too; no image has been built yet. Of CUDA, a
# host has the driver and NVIDIA's container toolkit (`docker run --gpus all`); everything else comes with the extra.
ARG PYTHON=3.12
FROM python:${PYTHON}-slim AS build
ARG CPU=x86-64-v3 EXTRAS=
COPY . /src
RUN /src/container/install /src /opt/sparklod "$CPU" "$EXTRAS"

FROM python:${PYTHON}-slim
ARG CPU=x86-64-v3
RUN useradd --create-home sparklod
COPY --from=build /opt/sparklod /opt/sparklod
# Kernels are loaded for the named level, also on a better processor.
ENV PATH=/opt/sparklod/bin:$PATH NUMBA_CPU_NAME=$CPU NUMBA_CACHE_DIR=/opt/sparklod/kernels
USER sparklod
WORKDIR /data
ENTRYPOINT ["sparklod"]
