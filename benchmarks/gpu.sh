#!/usr/bin/env bash
# Everything about a GPU in one go: gsplat's build, parity with float64, whole trainings, cost of an iteration
# against gsplat's own loop, a profile. Results and a table go to benchmarks/results/.
#
#   bash benchmarks/gpu.sh [arguments of benchmarks/gpu.py]     e.g. --scene SCENE --call 1
#   bash benchmarks/gpu.sh --pack DIR [arguments of benchmarks/gpu_pack.py]
#
# A stage that was stopped goes on where it was; what it has is kept in gpu-benchmark/.
set -euo pipefail
here=$PWD
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
[ -x .venv/bin/python ] && python=${PYTHON:-.venv/bin/python}
if [ -z "${CUDA_HOME:-}" ]; then # torch guesses it from where nvcc lies, which may be a link
  for found in /usr/local/cuda /usr/local/cuda-*; do
    if [ -f "$found/include/cuda_runtime.h" ]; then export CUDA_HOME="$found"; break; fi
  done
fi
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
if [ "${1:-}" = --pack ]; then
  shift
  case "${1:-}" in /* | -* | "") ;; *) set -- "$here/$1" "${@:2}" ;; esac
  exec "$python" benchmarks/gpu_pack.py "$@"
fi
exec "$python" benchmarks/gpu.py "$@"
