# docker build -t photonpano . && docker run --rm -v "$PWD:/work" photonpano     writes the folder demo
FROM python:3.13-slim AS base-arm64
FROM python:3.13-slim AS base-amd64
# For all processors with AVX2: the image may run on another one than the machine code is compiled on.
ENV NUMBA_CPU_NAME=x86-64-v3 NUMBA_CPU_FEATURES=""
FROM base-${TARGETARCH}
WORKDIR /source
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY framework framework
COPY plugins plugins
RUN pip install --no-cache-dir -c constraints.txt . && photonpano warm-up
WORKDIR /work
ENTRYPOINT ["photonpano"]
CMD ["demo", "demo"]
