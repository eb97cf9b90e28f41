# One image for every service: `docker build -t zencell .`; what runs in a container is its command (compose.yaml).
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml constraints.txt ./
# The packages first: they change less often than the code. An index of your own: --secret id=pip,src=pip.conf
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=secret,id=pip,target=/etc/pip.conf \
    python -m venv /opt/zencell \
 && python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"], sep="\n")' > needed \
 && /opt/zencell/bin/python -m pip install --disable-pip-version-check -c constraints.txt -r needed
COPY deploy/slim.py deploy/slim.py
COPY config config
# What only builds other programs, and the robots that no file of config/robots names.
RUN /usr/local/bin/python deploy/slim.py /opt/zencell config/robots

# The planning kernel, compiled as wherever the package is installed; the compiler stays behind in this stage.
FROM python:3.11-slim AS kernel
WORKDIR /src
COPY pyproject.toml setup.py ./
COPY common/planning/kernel/build.py common/planning/kernel/
COPY common/planning/kernel/src common/planning/kernel/src
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=secret,id=pip,target=/etc/pip.conf \
    mkdir zencell && touch zencell/__init__.py README.md \
 && python -m pip install --disable-pip-version-check --no-deps --editable .

FROM python:3.11-slim AS run
RUN apt-get update -q && apt-get install -q -y --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/* /var/cache/apt/*.bin
RUN useradd --uid 10001 --create-home zencell && mkdir -p /data && chown zencell /data
COPY --from=build /opt/zencell /opt/zencell
ENV PATH=/opt/zencell/bin:$PATH PYTHONPATH=/app PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
WORKDIR /app
COPY --chmod=755 deploy/zencell /opt/zencell/bin/zencell
COPY common common
COPY --from=kernel /src/common/planning/kernel/*.so common/planning/kernel/
COPY services services
COPY cli cli
COPY applications applications
COPY page page
COPY drivers drivers
COPY recording recording
COPY bridges bridges
COPY tools tools
COPY lab lab
COPY security security
COPY zencell zencell
COPY examples examples
COPY config config
USER zencell
HEALTHCHECK --interval=3s --timeout=10s --start-period=90s --retries=5 CMD ["python", "-m", "common.process.health"]
CMD ["zencell", "--help"]

# For compose.dev.yaml: restarts a service when its source changes. The base image's pip: this one's environment has none.
FROM run AS dev
USER root
COPY constraints.txt /tmp/
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=secret,id=pip,target=/etc/pip.conf \
    /usr/local/bin/python -m pip --python /opt/zencell/bin/python install -q --disable-pip-version-check \
      -c /tmp/constraints.txt watchfiles
COPY deploy/__init__.py deploy/watched.py deploy/
USER zencell

# For cells with `simulator: mujoco` (docs/pictures.md): `docker build --target physics`. Mesa's OpenGL, which needs no
# graphics card, is 250 MB: the others do without.
FROM run AS physics
USER root
RUN apt-get update -q && apt-get install -q -y --no-install-recommends libegl1 libgl1-mesa-dri libopengl0 \
 && rm -rf /var/lib/apt/lists/* /var/cache/apt/*.bin
COPY pyproject.toml constraints.txt /tmp/
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=secret,id=pip,target=/etc/pip.conf \
    python -c 'import tomllib; print(*tomllib.load(open("/tmp/pyproject.toml", "rb"))["project"]["optional-dependencies"]["physics"], sep="\n")' > /tmp/needed \
 && /usr/local/bin/python -m pip --python /opt/zencell/bin/python install -q --disable-pip-version-check \
      -c /tmp/constraints.txt -r /tmp/needed
USER zencell

FROM run
