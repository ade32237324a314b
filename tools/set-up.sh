# Sourced by tools/demo and tools/test: a virtual environment in .venv with edgepose and all that its tests need.
cd "$(dirname "${BASH_SOURCE[0]}")/.."
stamp=$(cat pyproject.toml constraints.txt | cksum)
if [ "$(cat .venv/installed 2>/dev/null)" != "$stamp" ]; then
  echo "Setting up: a virtual environment in .venv with edgepose and its dependencies."
  echo "PyTorch is most of it (about 200 MB to download); a few minutes the first time."
  "${PYTHON:-python3}" -m venv .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
  echo "$stamp" > .venv/installed
  echo "Set-up done."
fi
