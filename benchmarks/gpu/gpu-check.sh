#!/usr/bin/env bash
# Installs the bundle and tries it on the GPU, in four minutes: bash gpu-check.sh [--device cuda|cpu] [--output FOLDER] [--only PART,…] [--seconds N]
# PYTHON: the Python that has PyTorch, python3 by default. OUT: the folder of results, ./gpu-check-results by default.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
"${PYTHON:-python3}" "$here/install.py" "$here/installed"
export OUT="${OUT:-$PWD/gpu-check-results}"
cd "$here/project"
exec "$here/installed/bin/python" -m benchmarks.gpu.check "$@"
