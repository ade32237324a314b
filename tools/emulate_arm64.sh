#!/usr/bin/env bash
# Runs the commands of docs/guide/install.md on an emulated 64-bit ARM computer, and compares its poses with this machine's.
# Then runs the tests of decoders, clocks, calibration, filter and engines there.
#
#   sudo tools/emulate_arm64.sh [bookworm|trixie] [CPU...]
#
# CPU: qemu's name of a processor; the default is cortex-a72 (Raspberry Pi 4) and cortex-a76 (Raspberry Pi 5).
# Needs root, Debian's packages qemu-user-static, binfmt-support and mmdebstrap, and a Python with edgepose here: that of
# .venv (created by tools/demo), or PYTHON=/path/to/python3.
# Takes an hour and 3 GB below FOLDER (/var/tmp/edgepose-arm64). An existing installation there is reused.
set -eu
cd "$(dirname "$0")/.."
suite=${1:-bookworm}
[ $# -gt 0 ] && shift
[ $# -gt 0 ] || set -- cortex-a72 cortex-a76
python=${PYTHON:-.venv/bin/python}
export PYTHONPATH=$PWD:$PWD/export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
folder=${FOLDER:-/var/tmp/edgepose-arm64}/$suite
home=/home/rig  # in the emulated root
repository=$home/repository
log=$folder.log

register() {  # let qemu run ARM programs, also in a root that does not contain qemu
  [ -e /proc/sys/fs/binfmt_misc/register ] || mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc
  [ -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ] || cat /usr/lib/binfmt.d/qemu-aarch64.conf > /proc/sys/fs/binfmt_misc/register
}

make_root() {
  mkdir -p "$folder"
  mmdebstrap --quiet --arch=arm64 --variant=apt --include=ca-certificates,sudo "$suite" "$folder" || return 1
  # The same network settings as here, including the certificates of a proxy.
  cp /etc/resolv.conf "$folder/etc/resolv.conf"
  cp /etc/ssl/certs/ca-certificates.crt "$folder/etc/ssl/certs/ca-certificates.crt"
}

inside() {  # CPU, COMMANDS
  env -i HOME="$home" PATH=/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive QEMU_CPU="$1" \
    OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 PIP_CERT=/etc/ssl/certs/ca-certificates.crt chroot "$folder" bash -ec "cd $home; $2"
}

block() {  # N: print the Nth block of commands of the install page
  awk -v wanted="$1" '/^```/ { inside = !inside; if (inside) count++; next } inside && count == wanted' docs/guide/install.md
}

register
[ -e "$folder/etc" ] || make_root
mkdir -p "$folder$home"
for device in null zero urandom tty; do
  [ -e "$folder/dev/$device" ] || cp -a "/dev/$device" "$folder/dev/$device"
done
mountpoint -q "$folder/proc" || mount --bind /proc "$folder/proc"
trap 'umount "$folder/proc"' EXIT

rm -rf "$folder$repository"
git clone --quiet --bare . "$folder$repository"
if [ -e "$folder$home/edgepose" ]; then  # keep the installation, update the sources
  inside "$1" "cd edgepose && git fetch --quiet $repository HEAD && git reset --quiet --hard FETCH_HEAD &&
    .venv/bin/pip install --quiet --constraint constraints.txt ." > "$log" 2>&1
else
  block 1 | sed "s|REPOSITORY|$repository|; s|apt install|apt install -y|; s|pip install|pip install --progress-bar off|" > "$folder$home/install.sh"
  SECONDS=0
  inside "$1" "bash -e $home/install.sh" > "$log" 2>&1
  echo "installed in $SECONDS s under emulation"
  echo "apt: $(grep -hE '^(Need to get|  Download size)' "$log")"
  awk '/^ *Downloading .*[0-9.]+ [kM]B\)/ { size = $(NF - 1); sub(/\(/, "", size); total += /MB\)/ ? size : size / 1000 }
       END { printf "pip: %.0f MB downloaded\n", total }' "$log"
  echo "size of .venv: $(du -sm "$folder$home/edgepose/.venv" | cut -f1) MB"
fi
inside "$1" "edgepose/.venv/bin/pip list 2>/dev/null | grep -E '^(torch|numpy|scipy) '"

here=$(mktemp -d)
trap 'umount "$folder/proc"; rm -rf "$here"' EXIT
tries=$(block 2)
edgepose() { "$python" -m edgepose "$@"; }
calibrate=$(grep ' calibrate ' <<< "$tries") run=$(grep ' run ' <<< "$tries")
for model in birnn rnn; do
  eval "$(sed "s|.venv/bin/edgepose|edgepose|; s|calib.json|$here/calib.json|" <<< "$calibrate")" > /dev/null 2>&1
  eval "$(sed "s|.venv/bin/edgepose|edgepose|; s|calib.json|$here/calib.json|; s|poses.csv|$here/$model.csv|" <<< "$run") --model $model --precision f32" 2> /dev/null
  rm "$here/calib.json"
done
status=0
for cpu in "$@"; do
  for model in birnn rnn; do
    for runtime in torch numpy; do
      rm -f "$folder$home/edgepose/calib.json" "$folder$home/edgepose/poses.csv"
      SECONDS=0
      inside "$cpu" "cd edgepose; $calibrate; $run --model $model --runtime $runtime" > "$log" 2>&1 || { tail -n 5 "$log"; exit 1; }
      echo "$cpu $model $runtime: $(grep -o 'running.*;' "$log") $SECONDS s; $("$python" tools/compare_poses.py "$here/$model.csv" "$folder$home/edgepose/poses.csv")"
    done
  done
  for precision in fp16 int8; do  # a refusal is one line and exit code 1 or 2; an illegal instruction is 132
    code=0
    inside "$cpu" "cd edgepose; rm -f poses.csv; $run --model rnn --precision $precision" > "$log" 2>&1 || code=$?
    [ $code -lt 126 ] || status=1
    echo "$cpu $precision: exit code $code; $(grep -m 1 -E '^edgepose: |warning: ' "$log")"
  done
done

tests="tests/firmware_protocols tests/edgepose/sources/test_clock.py tests/edgepose/calibration tests/edgepose/orientation
  tests/edgepose/inference/test_engine.py tests/edgepose/inference/test_numpy_network.py"
# Of what tests need, only what these do: xsens's, x-io's and MicroStrain's own decoders exist for x86-64 only.
inside "$1" "sudo apt-get install -qq --no-install-recommends build-essential python3-dev
  cd edgepose; .venv/bin/pip install --quiet --constraint constraints.txt '.[mavlink,vqf]' adafruit-circuitpython-bno08x-rvc cantools cobs hypothesis pytest witmotion
  PYTHONPATH=\$PWD:\$PWD/export .venv/bin/python -m pytest -p no:cacheprovider --continue-on-collection-errors $(tr -d '\n' <<< "$tests")" > "$log" 2>&1 || status=1
echo "$1: tests: $(tail -n 1 "$log"); the rest is in $log"
exit $status
