"""An archive runs from C++ with libtorch and nothing of edgepose."""

import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from edgepose.inference import archive

SOURCE = Path(__file__).with_name("archive.cpp")


def test_stream_from_cpp(tmp_path):
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    assert compiler, "this test needs a C++ compiler (Debian: apt-get install g++)"
    folder = Path(torch.__file__).parent
    program = tmp_path / "stream"
    includes = [f"-I{folder / 'include'}", f"-I{folder / 'include/torch/csrc/api/include'}"]
    libraries = [f"-L{folder / 'lib'}", "-ltorch", "-ltorch_cpu", "-lc10", f"-Wl,-rpath,{folder / 'lib'}"]
    abi = f"-D_GLIBCXX_USE_CXX11_ABI={int(torch.compiled_with_cxx11_abi())}"
    command = [compiler, "-std=c++20", "-O0", abi, str(SOURCE), *includes, *libraries, "-o", str(program)]
    subprocess.run(command, check=True)
    path = archive.find_archive("birnn")
    words = subprocess.run([program, path], capture_output=True, text=True, check=True).stdout.split()
    assert words[:9] == ["0", "0", "0", "0", "0", "1", "1", "1", "5"]
    module = archive.load(archive.read_info(path))
    state = module.start(1, 5)
    for _ in range(8):
        rotations, _, state = module.stream(torch.eye(3).expand(1, 6, 3, 3), torch.zeros(1, 6, 3), state)
    assert float(words[9]) == pytest.approx(rotations[0, 0, 1, 0, 0].item(), abs=1e-4)
