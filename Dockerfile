# Skyquilt in a container:  docker build -t skyquilt .
#   docker run --rm -v "$PWD:/data" skyquilt mosaic /data/photos -o /data/out
#   docker run --rm -v "$PWD:/data" -p 8080:8080 skyquilt view /data/out --host 0.0.0.0 --token SECRET-WORD
FROM python:3.12-slim AS build
WORKDIR /source
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src ./src
RUN python -m venv /skyquilt \
    && /skyquilt/bin/pip install --no-cache-dir --constraint constraints.txt '.[live]' \
    && /skyquilt/bin/python -m compileall -q /skyquilt/lib

FROM python:3.12-slim
COPY --from=build /skyquilt /skyquilt
# results belong to whoever runs it: docker run --user "$(id -u):$(id -g)"
RUN useradd --create-home --uid 1000 pilot
USER 1000
WORKDIR /data
EXPOSE 8080
ENTRYPOINT ["/skyquilt/bin/skyquilt"]
CMD ["--help"]
