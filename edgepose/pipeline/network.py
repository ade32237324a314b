"""The network of a run: its settings, the archive it is stored in, and the engine that runs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from edgepose.errors import ConfigError

if TYPE_CHECKING:
    from edgepose.config import WearerConfig
    from edgepose.inference.archive import ArchiveInfo
    from edgepose.inference.engine import Engine, MultiWearerEngine
    from edgepose.inference.loading import LoadedNetwork


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """The network of a run and how it runs; the fields are flags of `edgepose run`.

    Attributes:
        model: name of a shipped model, or path of an archive.
        trust: load the archive even if its checksum is unknown.
        online: "stream" carries a bidirectional model's forward state from frame to frame; "window" computes
            a whole window for each frame.
        past: frames in a window before the present one; None takes the model's own number.
        future: frames after the present one that are waited for; None takes the model's own number.
        precision: number format of the weights, one of `edgepose.inference.quantisation.CHOICES`.
        runtime: what runs the network, one of `edgepose.inference.loading.RUNTIMES`.
    """

    model: str = "birnn"
    trust: bool = False
    online: str = "stream"
    past: int | None = None
    future: int | None = None
    precision: str = "auto"
    runtime: str = "auto"


@dataclass(frozen=True)
class Network:
    """A network whose archive has been read, but not loaded.

    Attributes:
        config: the settings it was read with.
        info: the archive and its metadata.
        past: frames in a window before the present one.
        future: frames after the present one that are waited for.
    """

    config: NetworkConfig
    info: ArchiveInfo
    past: int
    future: int

    @classmethod
    def read(cls, config: NetworkConfig, wearer_count: int) -> Network:
        """Read the metadata of an archive and check the settings against it.

        Raises:
            ModelError: there is no such archive, or it is damaged.
            ConfigError: the model or the number of wearers does not allow the settings.
        """
        from edgepose.inference import archive

        info = archive.read_info(archive.find_archive(config.model))
        network = cls(
            config,
            info,
            past=info.metadata["past"] if config.past is None else config.past,
            future=info.metadata["future"] if config.future is None else config.future,
        )
        most = info.metadata["future"]
        if network.future > most and not archive.is_windowed(info.metadata):
            raise ConfigError(
                f"{config.model} is unidirectional: --future must be 0"
                if most == 0
                else f"{config.model} sees {most} future frames: --future must be at most {most}"
            )
        if wearer_count > 1 and network.windowed:
            raise ConfigError("--online window runs one wearer; use --online stream for several")
        return network

    @property
    def kind(self) -> str:
        """Name of the network's architecture, such as "birnn"."""
        return str(self.info.metadata["kind"])

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return float(self.info.metadata["rate_hz"])

    @property
    def windowed(self) -> bool:
        """Whether a whole window is computed for each frame."""
        from edgepose.inference.archive import is_windowed

        return self.config.online == "window" and is_windowed(self.info.metadata)

    @property
    def has_place(self) -> bool:
        """Whether it estimates contacts and the velocity of the pelvis."""
        from edgepose.inference.archive import has_place

        return has_place(self.info.metadata)

    def values(self) -> Mapping[str, Any]:
        """Return the network for scripts; docs/reference/scripts.md describes the keys."""
        return {
            "model": self.config.model,
            "kind": self.kind,
            "mode": "window" if self.windowed else "stream",
            "rate_hz": self.rate_hz,
            "look_ahead_s": self.future / self.rate_hz,
        }

    @property
    def faster(self) -> list[str]:
        """Flags of `edgepose run` that would make it faster."""
        flags = ["--online stream"] if self.windowed else []
        return flags if self.kind == "rnn" else [*flags, "--model rnn"]

    def load(self, no_place: bool, notify: Callable[[str], None]) -> ReadyNetwork:
        """Load the network.

        Args:
            no_place: no wearer is followed through the room.
            notify: called with one message if the precision is slow here or had to be changed, and one if
                the model cannot tell where wearers are.

        Raises:
            ModelError: the archive is not trusted, or cannot run here.
        """
        from edgepose.inference.loading import load

        config = self.config
        loaded = load(self.info, config.trust, config.runtime, config.precision, notify)
        if not no_place and not self.has_place:
            notify(
                f"{config.model} does not estimate contacts: the lowest foot counts as standing still, "
                "so the path is less accurate"
            )
        return ReadyNetwork(self, loaded, self.has_place and not no_place)


class ReadyNetwork(NamedTuple):
    """A network that is loaded.

    Attributes:
        network: what was loaded, and how it is to run.
        loaded: its module.
        place: whether it estimates where wearers are.
    """

    network: Network
    loaded: LoadedNetwork
    place: bool

    @property
    def precision(self) -> str:
        """How it runs, "fp16" for example."""
        return self.loaded.precision + (" with numpy" if self.loaded.runtime == "numpy" else "")

    def engine(self, wearer: WearerConfig) -> Engine:
        """Return a new engine for one wearer."""
        from edgepose.inference.engine import FRAMES_PER_STEP, StreamEngine, WindowEngine

        network, module = self.network, self.loaded.module
        if network.windowed:
            return WindowEngine(module, network.past, network.future, place=self.place)
        # No one waits for single poses of a recording, so several frames go into a step.
        source = wearer.source
        recorded = not source.live and source.file is not None and source.file.is_file()
        together = recorded and self._batched and hasattr(module, "stream_many")
        frames_per_step = FRAMES_PER_STEP if together else 1
        return StreamEngine(module, network.past, network.future, frames_per_step, place=self.place)

    def engine_for_all(self, wearers: Sequence[WearerConfig]) -> Engine | MultiWearerEngine:
        """Return a new engine for one wearer, or for several who share the network."""
        from edgepose.inference.engine import MultiWearerEngine

        if len(wearers) == 1:
            return self.engine(wearers[0])
        network, isolate = self.network, not self._batched
        return MultiWearerEngine(
            *(self.loaded.module, network.past, network.future, len(wearers), isolate), place=self.place
        )

    @property
    def _batched(self) -> bool:
        # int8 activations share one scale per batch, so batching would change results.
        return self.loaded.precision != "int8"
