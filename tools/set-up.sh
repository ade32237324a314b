# Sourced by tools/demo and tools/test: creates a virtual environment in .venv with edgepose and its test dependencies.
cd "$(dirname "${BASH_SOURCE[0]}")/.."
stamp=$(cat pyproject.toml constraints.txt | cksum)
if [ "$(cat .venv/installed 2>/dev/null)" != "$stamp" ]; then
  python=${PYTHON:-python3}
  echo "Creating a virtual environment in .venv with edgepose and its dependencies."
  constraints=constraints.txt site_packages=
  # The PyTorch of this Python, if pyproject.toml allows its version. An environment that is made inside of another
  # one does not see the packages of that.
  found=$("$python" -c '
import platform
import sys
from importlib.metadata import version
found = version("torch") if sys.prefix == sys.base_prefix else ""
newest = (2, 9) if platform.machine() == "aarch64" else (2, 13)
print(found if (2, 4) <= tuple(map(int, found.split(".")[:2])) <= newest else "")' 2>/dev/null) || found=
  if [ "$found" ]; then
    echo "Using PyTorch $found of $python."
    mkdir -p .venv
    constraints=.venv/constraints.txt site_packages=--system-site-packages
    echo "torch==$found" > "$constraints"
  elif [ "$(uname -m)" = aarch64 ]; then
    echo "This downloads about 300 MB, a third of it PyTorch, unless pip has the files in its cache."
  else
    echo "This downloads the CUDA build of PyTorch (several GB), unless pip has it in its cache or its settings"
    echo "lead to a CPU build (about 200 MB); see docs/guide/install.md."
  fi
  "$python" -m venv $site_packages .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint "$constraints" --editable '.[dev]'
  echo "$stamp" > .venv/installed
  echo "Setup done."
fi
