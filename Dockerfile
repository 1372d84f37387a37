# docker build -t merge-sumo .
# docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" merge-sumo                 the first campaign
# docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" merge-sumo COMMAND ...     any other command
FROM python:3.12-slim-bookworm AS wheel
COPY . /checkout
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel /checkout

FROM python:3.12-slim-bookworm
# Shared libraries that SUMO's wheels load, even without a window.
RUN apt-get update \
 && apt-get install -y --no-install-recommends libgl1 libx11-6 libxext6 libxrender1 libatomic1 libexpat1 \
 && rm -rf /var/lib/apt/lists/*
COPY --from=wheel /wheel /wheel
RUN pip install --no-cache-dir /wheel/*.whl \
 && useradd --create-home merge \
 && install -d --owner=merge --mode=700 /work
# A place for the cache that any user of `--user` can make.
ENV MERGE_SUMO_CACHE=/tmp/merge-sumo
USER merge
WORKDIR /work
ENTRYPOINT ["merge-sumo"]
CMD ["campaign", "--vut", "design2"]
