"""Methods that can be compared, by name: each a dataclass of its parameters that recovers a trial's points.

To add one, write a dataclass with ``label`` and ``recover`` (or, if it returns an ``Attack``, ``build``) and list it in
``CONTENDERS``. A user's own method needs no entry: ``{name: call, path: package.module:callable}``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from l2p.attacks.attack import Attack
from l2p.attacks.learned import checkpoint
from l2p.attacks.named import imported, named_attack
from l2p.attacks.run import run
from l2p.attacks.settings import ATTACKS, METHODS
from l2p.checks import finite_rows
from l2p.errors import InputError
from l2p.io.kinds import Kind, kind_of
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene
from l2p.judging.references import CandidateOracle, LeaveOneOut, Oracle
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.programs.scenes import PAPER_KIND


@dataclass(frozen=True, eq=False)
class Trial:
    """Line cloud to attack. Only references may use ``truth``, (lines, 3) in the order of the lines."""

    key: str
    lines: LineCloud
    truth: Float[np.ndarray, "lines 3"]
    kind: str
    fraction: float
    seed: int
    device: str


@runtime_checkable
class Contender(Protocol):
    """Method with its parameters."""

    #: Whether it is a reference, which uses the truth, rather than an attack.
    knows_truth: ClassVar[bool]
    #: Whether the duration of ``recover`` is the running time of the method.
    timed: ClassVar[bool]

    @property
    def label(self) -> str:
        """Name in tables; unique in a run."""
        ...

    def files(self, cloud: str) -> dict[str, str]:
        """Return digests of the files read for the line cloud of that name: the prediction depends on them, too."""
        ...

    def recover(self, trial: Trial) -> Recovery:
        """Recover the points."""
        ...


@dataclass(frozen=True)
class Peer:
    """Method that is built for a trial and run by :func:`l2p.attacks.run.run`."""

    label: str = ""
    knows_truth: ClassVar[bool] = False
    timed: ClassVar[bool] = True

    def build(self, trial: Trial) -> Attack:
        """Build the method for this trial."""
        raise NotImplementedError

    def files(self, cloud: str) -> dict[str, str]:
        """Return no digests: it reads no files."""
        return {}

    def recover(self, trial: Trial) -> Recovery:
        """Build, then run."""
        return run(trial.lines, self.build(trial), device=trial.device, name=self.label)


@dataclass(frozen=True)
class AttackContender(Peer):
    """Attack by its name, or a user's own by ``package.module:Attack``.

    Attacks of l2p get the true fraction and kind of scene, unless ``settings`` has other values.
    """

    name: str = ""
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _default_label(self, self.name.rpartition(":")[2])
        named_attack(self.name, **self.settings)  # refused before any work

    def build(self, trial: Trial) -> Attack:
        """Build the attack for this trial."""
        known = {"fraction": trial.fraction, "scene_kind": PAPER_KIND[trial.kind]}
        names = ATTACKS[self.name].names if self.name in ATTACKS else ()
        own = {name: value for name, value in known.items() if name in names}
        return named_attack(self.name, **{**own, **self.settings})

    def files(self, cloud: str) -> dict[str, str]:
        """Return the digest of the checkpoint."""
        if "checkpoint" not in (ATTACKS[self.name].names if self.name in ATTACKS else ()):
            return {}
        return {"digest": checkpoint.digest(self.settings.get("checkpoint") or checkpoint.shipped())}


@dataclass(frozen=True)
class OracleContender(Peer):
    """Oracle with the true neighbours, a share of them replaced by random lines."""

    label: str = ""
    k: int = 50
    outliers: float = 0.0
    knows_truth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        wrong = f", {self.outliers:.0%} outliers" if self.outliers else ""
        _default_label(self, f"oracle {self.k}{wrong}")

    def build(self, trial: Trial) -> Attack:
        """Build the oracle; its outliers follow from the seed of the lifting."""
        return Oracle(trial.truth, self.k, self.outliers, trial.seed)


@dataclass(frozen=True)
class CandidateOracleContender(Peer):
    """Oracle with the true neighbours among the candidates of an attack, by default of the heuristic."""

    label: str = ""
    k: int = 50
    candidates: int = 200
    attack: dict[str, Any] = field(default_factory=lambda: {"name": "heuristic"})
    knows_truth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _default_label(self, f"candidate oracle {self.k}")

    def build(self, trial: Trial) -> Attack:
        """Build the oracle on the candidates of the attack."""
        return CandidateOracle(trial.truth, self._peer().build(trial), self.k, self.candidates)

    def files(self, cloud: str) -> dict[str, str]:
        """Return the digests of the attack."""
        return self._peer().files(cloud)

    def _peer(self) -> Peer:
        attack = contender_of(self.attack)
        if not isinstance(attack, Peer):
            raise InputError(f"got attack {self.attack}; expected a method of l2p, whose estimates give candidates")
        return attack


@dataclass(frozen=True)
class LeaveOneOutContender(Peer):
    """Leave-one-out bound: all other points are known."""

    label: str = "LOO"
    k: int = 128
    knows_truth: ClassVar[bool] = True

    def build(self, trial: Trial) -> Attack:
        """Build the bound for these points."""
        return LeaveOneOut(trial.truth, self.k)


@dataclass(frozen=True)
class UserAttackContender(AttackContender):
    """User's :class:`l2p.attacks.attack.Attack` at ``path``, ``package.module:Attack``, with its ``settings``."""

    path: str = MISSING

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.path)
        super().__post_init__()


@dataclass(frozen=True)
class CallContender:
    """User's callable that takes a LineCloud and ``arguments`` and returns points (lines, 3) or a Recovery.

    ``calibrated``: whether the confidence is a probability; None to use the value in the Recovery.
    """

    path: str
    label: str = ""
    arguments: dict[str, Any] = field(default_factory=dict)
    calibrated: bool | None = None
    knows_truth: ClassVar[bool] = False
    timed: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _default_label(self, self.path.rpartition(":")[2])
        imported(self.path)

    def recover(self, trial: Trial) -> Recovery:
        """Call it with the lines and ``arguments``, without the truth."""
        answer = imported(self.path)(trial.lines, **self.arguments)
        return as_recovery(answer, trial.lines, self.path, self.calibrated)

    def files(self, cloud: str) -> dict[str, str]:
        """Return no digests: its code may change between cells, as that of l2p may."""
        return {}


@dataclass(frozen=True)
class FolderContender:
    """Recoveries, or bare points in the order of the lines, by other programs: ``FOLDER/SCENE_PERCENT_SEED.npz`` for
    the lines of ``l2p lift --fraction F --seed S``.

    ``calibrated``: whether the confidence is a probability; None to use the value in the files.
    """

    path: str
    label: str = ""
    calibrated: bool | None = None
    knows_truth: ClassVar[bool] = False
    timed: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _default_label(self, Path(self.path).name)

    def recover(self, trial: Trial) -> Recovery:
        """Read the recovery; bare points all get the same confidence."""
        file = self._file(trial.key)
        bare = kind_of(file) is Kind.SCENE_NPZ
        answer = load_scene(file).xyz if bare else load_recovery(file)
        return as_recovery(answer, trial.lines, str(file), self.calibrated)

    def files(self, cloud: str) -> dict[str, str]:
        """Return the digest of the recovery."""
        file = self._file(cloud)
        return {"digest": checkpoint.digest(file) if file.is_file() else "no file"}

    def _file(self, cloud: str) -> Path:
        return Path(self.path) / f"{cloud}.npz"


#: Every method that a config may name, in addition to the attacks of l2p.
CONTENDERS: dict[str, type[Any]] = {
    "oracle": OracleContender,
    "candidate_oracle": CandidateOracleContender,
    "loo": LeaveOneOutContender,
    "attack": UserAttackContender,
    "call": CallContender,
    "folder": FolderContender,
}


def contenders_of(entries: list[dict[str, Any]]) -> tuple[Contender, ...]:
    """Build the methods of a config, whose labels must differ."""
    contenders = tuple(contender_of(entry) for entry in entries)
    labels = [contender.label for contender in contenders]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"got {labels.count(label)} methods with the label {label!r}; give each its own label")
    return contenders


def contender_of(entry: dict[str, Any]) -> Contender:
    """Build the method of one entry of a config.

    Raises
    ------
    InputError
        If the name or a parameter is unknown or of another type.
    """
    name = entry.get("name")
    if name not in CONTENDERS and name not in ATTACKS:
        raise InputError(f"got method {name!r}; expected a name of {', '.join((*METHODS, *CONTENDERS))}")
    parameters = {key: value for key, value in entry.items() if key != "name"}
    try:
        if name in ATTACKS:
            settings = {key: value for key, value in parameters.items() if key != "label"}
            checked: Any = OmegaConf.merge(OmegaConf.structured(ATTACKS[name].settings), settings)
            given = {key: checked[key] for key in settings if checked[key] is not None}
            return AttackContender(parameters.get("label") or name, name, given)
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(CONTENDERS[name]), parameters))  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        sentence = str(error).splitlines()[0]
        raise InputError(f"got parameters {parameters} for method {name}: {sentence}") from error


def identity_of(contender: Contender, cloud: str) -> dict[str, Any]:
    """Return all inputs of a prediction for that line cloud except the code: parameters, and digests of files."""
    parameters = asdict(contender)  # type: ignore[call-overload]
    if parameters.get("calibrated", 0) is None:
        del parameters["calibrated"]  # records of earlier versions have no such entry
    return {"class": type(contender).__name__, **parameters, **contender.files(cloud)}


def as_recovery(answer: Any, lines: LineCloud, source: str, calibrated: bool | None = None) -> Recovery:
    """Convert a user's answer to a Recovery; bare points stay as they are, all with the same confidence."""
    points = answer.xyz if isinstance(answer, Recovery) else finite_rows("points", answer)
    if isinstance(answer, Recovery) and not answer.one_each:
        if answer.element.max() >= len(lines):
            raise InputError(f"got element {answer.element.max()} of {source}; expected rows of the {len(lines)} lines")
    elif len(points) != len(lines):
        raise InputError(f"got {len(points)} points of {source} for {len(lines)} lines; expected one a line, in order")
    if isinstance(answer, Recovery):
        return answer if calibrated is None else replace(answer, calibrated=calibrated)
    beta = np.sum((points - lines.origin) * lines.direction, axis=1)
    return Recovery(points, np.ones(len(points), dtype=np.float32), beta, calibrated=bool(calibrated))


def _default_label(contender: Any, label: str) -> None:
    if not contender.label:
        object.__setattr__(contender, "label", label)
