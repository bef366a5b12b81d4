#!/usr/bin/env bash
# Everything about a GPU in one go: gsplat's build, parity with float64, whole trainings, cost of an iteration
# against gsplat's own loop, a profile. Results and a table go to benchmarks/results/.
#
#   bash benchmarks/gpu.sh [arguments of benchmarks/gpu.py]     e.g. --scene SCENE --set refinesplat.features=dinov2-small
#
# A finished training is kept in gpu-benchmark/ and not made again.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
[ -x .venv/bin/python ] && python=${PYTHON:-.venv/bin/python}
if [ -z "${CUDA_HOME:-}" ]; then # torch guesses it from where nvcc lies, which may be a link
  for found in /usr/local/cuda /usr/local/cuda-*; do
    if [ -f "$found/include/cuda_runtime.h" ]; then export CUDA_HOME="$found"; break; fi
  done
fi
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
exec "$python" benchmarks/gpu.py "$@"
