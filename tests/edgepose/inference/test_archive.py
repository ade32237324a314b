import hashlib
import io
import json
import logging
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.inference import archive
from edgepose.inference.engine import WindowEngine
from edgepose.pose import CONTACTS
from edgepose_export.networks.shape import NetworkShape


@pytest.fixture(autouse=True)
def own_settings(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


@pytest.fixture(scope="module")
def made(tmp_path_factory, write_archive):
    """A small bidirectional archive with past 4 and future 2."""
    return write_archive(tmp_path_factory.mktemp("archive") / "small.pt")


def with_metadata(source, path, text):
    """The archive with other metadata."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            own = entry.filename.endswith("edgepose.json")
            new.writestr(entry, text if own else old.read(entry))
    return path


def metadata_of(path):
    with zipfile.ZipFile(path) as file:
        name = next(name for name in file.namelist() if name.endswith("extra/edgepose.json"))
        return json.loads(file.read(name))


def fails(path, message):
    with pytest.raises(EdgeposeError, match=message) as caught:
        archive.read_info(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


# --- what is an archive -------------------------------------------------------------------------------------


def test_inspect(made):
    info = archive.read_info(made)
    assert info.path == made
    assert info.sha256 == hashlib.sha256(made.read_bytes()).hexdigest()
    assert not info.trusted
    assert info.metadata == metadata_of(made)


@pytest.mark.parametrize("content", [b"", b"no zip at all", b"PK\x03\x04" + bytes(100)])
def test_not_a_zip(tmp_path, content):
    path = tmp_path / "x.pt"
    path.write_bytes(content)
    fails(path, "not a model archive")


def test_missing_or_a_folder(tmp_path):
    fails(tmp_path / "none.pt", "No such file")
    fails(tmp_path, "directory")


def test_zip_without_metadata(tmp_path, tiny):
    path = tmp_path / "plain.pt"
    torch.save({"weights": torch.ones(3)}, path)
    fails(path, "no edgepose.json")


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.9, 0.999])
def test_truncated(tmp_path, made, keep):
    content = made.read_bytes()
    path = tmp_path / "cut.pt"
    path.write_bytes(content[: int(keep * len(content))])
    fails(path, "no complete zip")


def test_one_byte_changed_is_another_sum(tmp_path, made):
    archive.trust(made)
    content = bytearray(made.read_bytes())
    content[len(content) // 2] ^= 1
    path = tmp_path / "changed.pt"
    path.write_bytes(content)
    info = archive.read_info(path)
    assert archive.read_info(made).trusted
    assert not info.trusted
    with pytest.raises(EdgeposeError, match=r"is not known.*--trust"):
        archive.load(info)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": 2}, "format 2 is newer.*update edgepose"),
        ({"format": "1"}, "not what edgepose export writes"),
        ({"kind": 7}, "kind of network 7 is not a name"),
        ({"windowed": "yes"}, "is neither true nor false"),
        ({"placements": ["head", "pelvis"]}, "other sensor placements"),
        ({"placements": None}, "other sensor placements"),
        ({"rate_hz": 0}, "not a rate"),
        ({"rate_hz": float("nan")}, "not a rate"),
        ({"rate_hz": "60"}, "not a rate"),
        ({"past": None}, "past frames None"),
        ({"past": 10**9}, "past frames"),
        ({"future": -1}, "future frames -1"),
        ({"future": True}, "future frames True"),
    ],
)
def test_wrong_metadata(tmp_path, made, changes, message):
    text = json.dumps(metadata_of(made) | changes)
    fails(with_metadata(made, tmp_path / "odd.pt", text), message)


@pytest.mark.parametrize("text", ["[1, 2]", "{}", "null"])
def test_metadata_that_is_no_description(tmp_path, made, text):
    fails(with_metadata(made, tmp_path / "odd.pt", text), "not what edgepose export writes")


@pytest.mark.parametrize("text", ["", "{", b"\xff\xfe{}", "[" * 100_000, '{"format": ' + "9" * 5000 + "}"])
def test_metadata_that_is_no_json(tmp_path, made, text):
    fails(with_metadata(made, tmp_path / "odd.pt", text), "metadata cannot be read")


def test_endless_metadata_is_not_unpacked(tmp_path):
    path = tmp_path / "bomb.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("x/extra/edgepose.json", bytes(50 << 20))
    fails(path, "not a model archive of edgepose")


def test_former_names(tmp_path, monkeypatch, capsys):
    """They are found once nothing bundled has them, with one note from the command line."""
    for name, copy in (("birnn", "birnn"), ("rnn", "rnn-cmu")):
        shutil.copy(archive.find_archive(name), tmp_path / f"{copy}.pt")
    monkeypatch.setattr(archive, "MODELS", tmp_path)
    assert set(archive.ALIASES.values()) == {"birnn", "rnn"}
    logger = logging.getLogger("edgepose")
    monkeypatch.setattr(logger, "level", logging.INFO)
    assert archive.find_archive("rnn-cmu") == tmp_path / "rnn-cmu.pt"
    with pytest.raises(EdgeposeError, match="rnn: no such model; did you mean"):
        archive.find_archive("rnn")
    archive._note_alias.cache_clear()
    records = []
    monkeypatch.setattr(logger, "handlers", [handler := logging.Handler()])
    monkeypatch.setattr(handler, "emit", lambda record: records.append(record.getMessage()))
    for _ in range(2):
        assert archive.find_archive("birnn-cmu") == tmp_path / "birnn.pt"
    assert records == ["model birnn-cmu is called birnn now"]


def test_find(tmp_path, made, monkeypatch):
    assert archive.find_archive(str(made)) == made
    monkeypatch.chdir(made.parent)
    assert archive.find_archive("small.pt") == Path("small.pt")
    with pytest.raises(EdgeposeError, match="no such model; give the path of an archive, or one of"):
        archive.find_archive(str(tmp_path / "none.pt"))
    for path in archive.bundled_archives():
        assert archive.find_archive(path.stem) == path
        assert archive.read_info(path).trusted


# --- trust --------------------------------------------------------------------------------------------------


def test_unknown_archive_is_not_loaded_unless_vouched_for(made):
    info = archive.read_info(made)
    with pytest.raises(EdgeposeError, match="loading a model archive runs its code") as caught:
        archive.load(info)
    assert info.sha256[:16] in str(caught.value)
    module = archive.load(info, trust=True)
    frame = np.tile(np.eye(3), (6, 1, 1)), np.zeros((6, 3))
    assert len(WindowEngine(module, 4, 0).push(0, *frame)) == 1
    assert torch.get_num_threads() == 1
    assert not torch.backends.mkldnn.enabled


def test_trusted_list_is_the_users_own(tmp_path, made):
    listed = tmp_path / "config" / "edgepose" / "trusted-archives"
    assert archive.trust_file() == listed
    assert not listed.exists()
    assert archive.trust(made).trusted
    assert listed.read_text().split() == [archive.read_info(made).sha256, "small.pt"]
    archive.trust(made)
    assert len(listed.read_text().split()) == 2  # once is enough
    assert archive.load(archive.read_info(made)) is not None


def test_list_without_a_last_line_break_and_with_other_text(tmp_path, made):
    listed = archive.trust_file()
    listed.parent.mkdir(parents=True)
    listed.write_bytes(b"# mine\n\xff\n\n" + b"0" * 64 + b"  other.pt")
    archive.trust(made)
    assert archive.read_info(made).trusted
    assert "0" * 64 in listed.read_text(errors="replace").split()


def test_a_file_name_adds_no_sum(tmp_path, made):
    other = "0123456789abcdef" * 4
    path = tmp_path / f"a\n{other}\n.pt"
    path.write_bytes(made.read_bytes())
    archive.trust(path)
    assert not [line for line in archive.trust_file().read_text().splitlines() if line.startswith(other)]


def test_list_that_cannot_be_written(tmp_path, made):
    (tmp_path / "config").write_text("a file where a folder should be")
    with pytest.raises(EdgeposeError, match="trusted-archives"):
        archive.trust(made)


def test_archive_that_changes_after_its_inspection(tmp_path, made):
    path = tmp_path / "small.pt"
    path.write_bytes(made.read_bytes())
    info = archive.read_info(path)
    path.write_bytes(made.read_bytes() + b" ")
    with pytest.raises(EdgeposeError, match="changed while"):
        archive.load(info, trust=True)


def test_trusted_archive_that_torch_cannot_load(tmp_path, made):
    path = tmp_path / "empty.pt"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("empty/extra/edgepose.json", json.dumps(metadata_of(made)))
    with pytest.raises(EdgeposeError, match="torch cannot load the archive") as caught:
        archive.load(archive.read_info(path), trust=True)
    assert "\n" not in str(caught.value)


# --- code of strangers --------------------------------------------------------------------------------------


class Writer(torch.nn.Module):
    """Writes a file while it is loaded."""

    def __init__(self, target):
        super().__init__()
        self.target: str = target

    def forward(self, x):
        return x

    @torch.jit.export
    def __getstate__(self):
        return self.target, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[str, bool]):
        self.target = state[0]
        self.training = state[1]
        torch.save(torch.ones(1), state[0])


def test_code_of_a_stranger_is_not_run(tmp_path, made):
    target, path = tmp_path / "written", tmp_path / "evil.pt"
    module = torch.jit.script(Writer(str(target)))
    torch.jit.save(module, str(path), _extra_files={archive.METADATA_FILE: json.dumps(metadata_of(made))})
    target.unlink(missing_ok=True)
    info = archive.read_info(path)
    with pytest.raises(EdgeposeError, match="is not known"):
        archive.load(info)
    shown = CliRunner().invoke(cli, ["models", str(path)])
    assert shown.exit_code == 0
    assert not target.exists()
    # The same file does write once the user vouches for it: the check above was about something.
    torch.jit.load(io.BytesIO(path.read_bytes()))
    assert target.exists()


def test_inspection_needs_no_torch(made):
    program = (
        "import sys; from pathlib import Path; from edgepose.inference import archive; "
        "info = archive.read_info(Path(sys.argv[1])); archive.trust(Path(sys.argv[1])); "
        "print(info.metadata['name'], 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program, made], capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["small", "False"], done.stderr


def test_models_command(tmp_path, made):
    run = CliRunner().invoke
    shown = run(cli, ["models", str(made)])
    assert shown.exit_code == 0
    assert 'kind: "birnn"' in shown.output
    assert "trusted: no" in shown.output
    assert "trusted: yes" in run(cli, ["models", "--trust", str(made)]).output
    assert "trusted: yes" in run(cli, ["models", str(made)]).output
    assert run(cli, ["models", "--trust"]).exit_code == 2
    assert run(cli, ["models"]).exit_code == 0
    steering = json.dumps(metadata_of(made) | {"name": "\x1b[2J"})
    odd = with_metadata(made, tmp_path / "odd.pt", steering)
    assert "\x1b" not in run(cli, ["models", str(odd)], color=True).output


# --- the place ----------------------------------------------------------------------------------------------


def test_contacts_that_an_archive_estimates(tmp_path, write_archive):
    shape = NetworkShape("rnn", 8, "global-6d", "passed", place=True)
    path = write_archive(tmp_path / "place.pt", shape)
    assert archive.has_place(archive.read_info(path).metadata)
    assert not archive.has_place(archive.read_info(write_archive(tmp_path / "plain.pt")).metadata)
    for place in (None, 7, {}, {"contacts": ["left_ankle"]}, {"contacts": [*CONTACTS, "head"]}):
        text = json.dumps(metadata_of(path) | {"place": place})
        fails(with_metadata(path, tmp_path / "other.pt", text), "estimates other contacts than this edgepose")


def test_contacts_that_are_only_in_the_metadata(tmp_path, write_archive):
    path = write_archive(tmp_path / "plain.pt", place={"contacts": list(CONTACTS)})
    with pytest.raises(EdgeposeError, match=r"plain.pt: the contacts that its metadata name are missing"):
        archive.load(archive.read_info(path), trust=True)
