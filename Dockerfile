# docker build -t photonpano . && docker run --rm -v "$PWD:/work" photonpano     writes the folder demo
FROM python:3.13-slim
WORKDIR /source
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY framework framework
COPY plugins plugins
RUN pip install --no-cache-dir -c constraints.txt . && photonpano warm-up
WORKDIR /work
ENTRYPOINT ["photonpano"]
CMD ["demo", "demo"]
