# An image that runs the study on CPU cores, or on GPUs: see docs/machines.md.
FROM python:3.11-slim

# For the CPU. PyPI's own wheel of torch is for GPUs, where large encoders are compiled and need gcc and libc6-dev.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG SYSTEM_PACKAGES=make
ENV PIP_NO_CACHE_DIR=1

RUN apt-get update && apt-get install --yes --no-install-recommends $SYSTEM_PACKAGES && rm -rf /var/lib/apt/lists/*
RUN useradd --create-home study && mkdir -p /study/mlruns /study/data /study/reports && chown -R study: /study
USER study
WORKDIR /study

# Packages change less often than code: they have a layer of their own.
COPY --chown=study requirements.lock ./
RUN python -m venv .venv && .venv/bin/pip install --extra-index-url "$TORCH_INDEX" --requirement requirements.lock

COPY --chown=study Makefile pyproject.toml README.md LICENSE ./
COPY --chown=study sweeps sweeps
COPY --chown=study examples examples
COPY --chown=study study study
RUN make install

# The image has no .git: results name the commit that is given here, as in an archive of git's.
ARG COMMIT
RUN if [ -n "$COMMIT" ]; then echo "node: $COMMIT" > .git_archival.txt; fi

VOLUME ["/study/mlruns", "/study/data", "/study/reports"]
ENV PATH="/study/.venv/bin:$PATH"
CMD ["make", "heads", "ARGS=--profile smoke"]
