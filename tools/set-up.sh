# Sourced by tools/demo and tools/test: a virtual environment in .venv with edgepose and all that its tests need.
cd "$(dirname "${BASH_SOURCE[0]}")/.."
stamp=$(cat pyproject.toml constraints.txt | cksum)
if [ "$(cat .venv/installed 2>/dev/null)" != "$stamp" ]; then
  python=${PYTHON:-python3}
  echo "Setting up: a virtual environment in .venv with edgepose and its dependencies."
  constraints=constraints.txt site_packages=
  # A PyTorch of those that pyproject.toml allows.
  own=$("$python" -c '
import platform
from importlib.metadata import version
own = version("torch")
newest = (2, 9) if platform.machine() == "aarch64" else (2, 13)
print(own if (2, 4) <= tuple(map(int, own.split(".")[:2])) <= newest else "")' 2>/dev/null) || own=
  if [ "$own" ]; then
    echo "PyTorch $own, which $python has, is used."
    mkdir -p .venv
    constraints=.venv/constraints.txt site_packages=--system-site-packages
    echo "torch==$own" > "$constraints"
  elif [ "$(uname -m)" = aarch64 ]; then
    echo "About 300 MB are downloaded unless pip has them already, a third of that PyTorch."
  else
    echo "PyTorch is most of it. Unless pip has it already, or its settings lead to a CPU build (some 200 MB),"
    echo "the CUDA build is downloaded, several GB; see docs/guide/install.md."
  fi
  "$python" -m venv $site_packages .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint "$constraints" --editable '.[dev]'
  echo "$stamp" > .venv/installed
  echo "Set-up done."
fi
