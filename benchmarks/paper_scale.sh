#!/usr/bin/env bash
# The study at the paper's scale on a GPU machine without network; every step can be stopped and given again.
set -euo pipefail

usage() {
  cat >&2 <<'END'
usage: benchmarks/paper_scale.sh pack FOLDER [--profile P] [--group.setting VALUE ...]   where there is a network
       FOLDER/benchmarks/paper_scale.sh train [SECONDS]                                  on the GPU machine
       benchmarks/paper_scale.sh import FOLDER                                           where MLflow is

pack    puts the last commit, wheels and recorded drives into FOLDER (default: --profile paper). Copy it to the GPU
        machine then.
train   renders the frames and trains the cells for at most SECONDS (default 540). It exits with 75 while cells are left:
            while bash FOLDER/benchmarks/paper_scale.sh train; [ $? = 75 ]; do :; done
        Copy FOLDER/results back then, into FOLDER.
import  commits the results to MLflow and writes the report, in the working folder it is called from.

The GPU machine needs Python with torch, lightning, numpy, pandas, pyarrow and OpenCV; nothing is fetched there. With Dask
all its cores and GPUs are used, without it cells are trained one after the other on one GPU.
Environment, of pack unless said otherwise:
  PYTHON   the Python to use (all steps; default: .venv/bin/python beside the code, else python3)
  SWEEP    the sweep, with options of its grid if need be (default: heads)
  THERE    version of the GPU machine's Python, x86-64 (default: 3.12)
  WHEELS   packages that the GPU machine lacks, as in requirements.lock (default: pydantic and its needs, pyyaml, click,
           safetensors, filelock; "" for none)
  DASK     no (default), or yes: then Dask's wheels (4 MB) travel, too
  RECORD   here (default), or there: then the simulator's wheels (15 MB) travel instead of the drives (0.6 GB), and the
           GPU machine needs matplotlib and scipy
END
  exit 2
}

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
python=${PYTHON:-$root/.venv/bin/python}
[ -x "$(command -v "$python")" ] || python=python3
case $python in */*) python=$(cd "$(dirname "$python")" && pwd)/$(basename "$python") ;; esac

pack() {
  local folder=$1 there=${THERE:-3.12} record=${RECORD:-here} name platform grid options=() pins=() drives=()
  shift
  [ $# -gt 0 ] || set -- --profile paper
  read -ra grid <<< "${SWEEP:-heads}"
  local wheels=${WHEELS-pydantic pydantic-core annotated-types typing-inspection typing-extensions pyyaml click safetensors filelock}
  [ "${DASK:-no}" = no ] || wheels+=" distributed dask cloudpickle fsspec jinja2 markupsafe locket msgpack packaging \
    partd psutil sortedcontainers tblib toolz tornado zict importlib-metadata zipp"
  [ "$record" = here ] || wheels+=" highway-env gymnasium farama-notifications cloudpickle pygame-ce"
  mkdir -p "$folder/wheels"
  git -C "$root" archive HEAD study sweeps benchmarks requirements.lock .git_archival.txt | tar -x -C "$folder"
  printf '%s\n' "${grid[@]}" "$@" > "$folder/settings"
  for name in $wheels; do
    pins+=("$(grep "^$name==" "$root/requirements.lock")")
  done
  if [ ${#pins[@]} -gt 0 ]; then
    for platform in manylinux_2_28 manylinux_2_17 manylinux2014; do
      options+=(--platform "${platform}_x86_64")
    done
    "$python" -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
      --implementation cp --python-version "$there" "${options[@]}" --dest "$folder/wheels" "${pins[@]}"
  fi
  cd "$folder"
  if [ "$record" = here ]; then
    while [ $# -gt 1 ]; do # the settings of the drives alone
      case $1 in --profile | --town.* | --recording.*) drives+=("$1" "$2") ;; esac
      shift 2
    done
    PYTHONPATH=.${PYTHONPATH:+:$PYTHONPATH} "$python" -m study.data record "${drives[@]}"
  fi
  echo "packed: $(du -sh . | cut -f1) in $folder" >&2
}

train() {
  local words
  cd "$root"
  if [ ! -d site ]; then
    rm -rf site.draft && mkdir site.draft
    if compgen -G 'wheels/*.whl' > /dev/null; then
      "$python" -m pip install --quiet --disable-pip-version-check --no-index --no-deps --target site.draft wheels/*.whl
    fi
    mv site.draft site
  fi
  mapfile -t words < settings
  PYTHONPATH=.:site${PYTHONPATH:+:$PYTHONPATH} exec "$python" -m study.sweep train "${words[@]}" --out results \
    --limit-seconds "${1:-540}"
}

import() {
  local words
  mapfile -t words < "$1/settings"
  PYTHONPATH=$root${PYTHONPATH:+:$PYTHONPATH} exec "$python" -m study.sweep import "${words[@]}" "$1/results"
}

case "${1:-} $#" in
  'pack '[2-9]* | 'pack '[1-9][0-9]*) pack "${@:2}" ;;
  'train 1' | 'train 2') train "${@:2}" ;;
  'import 2') import "$2" ;;
  *) usage ;;
esac
