# docker build --target cpu --tag cortado .
# docker build --target cuda --tag cortado:cuda .    (run with: docker run --gpus all)
FROM python:3.12-slim AS wheel
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source /source/reference

FROM python:3.12-slim AS cpu
# The reference engine needs libgomp and libquadmath.
RUN apt-get update && apt-get install --yes --no-install-recommends libgomp1 libquadmath0 && rm -rf /var/lib/apt/lists/*
COPY --from=wheel /wheels /wheels
RUN pip install --no-cache-dir "$(echo /wheels/cortado_sph-*.whl)[video]" /wheels/cortado_reference-*.whl && rm -rf /wheels
WORKDIR /work
ENTRYPOINT ["cortado"]

FROM cpu AS cuda
# Warp brings CUDA along but for the driver, which the container runtime of the host puts in.
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
