# docker build -t slipid .
# docker run --rm -v "$PWD:/work" slipid identify robot.toml --data logs --out out
FROM python:3.11-slim AS build
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir build && python -m build --wheel --outdir /dist

FROM python:3.11-slim
# EGL draws pictures of the test site without a graphics card
RUN apt-get update && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /dist /dist
RUN pip install --no-cache-dir "$(ls /dist/*.whl)[all]" && rm -r /dist
# results belong to whoever owns the mounted folder: docker run --user "$(id -u):$(id -g)"
ENV SLIPID_CACHE=/tmp/slipid MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /work
ENTRYPOINT ["slipid"]
CMD ["--help"]
