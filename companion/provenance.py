"""What flew: versions of the daemon, of Python and of the packages, the commit, and the policy's artefact."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

import msgspec

from companion import __version__
from companion.config import Config, config_hash
from companion.errors import ConfigError
from companion.policy import artifact_folder, read_manifest

_ALSO = ("numpy", "scipy", "pymavlink", "eclipse-zenoh", "msgspec", "osqp", "daqp", "onnxruntime", "mcap")


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """``/companion/metadata``: what wrote a log and what flew."""

    version: str
    python: str
    platform: str
    packages: dict[str, str]
    commit: str | None  # of the checkout that the daemon runs from, where it does
    artifact: str  # of the configuration
    artifact_digest: str | None  # SHA-256 of its manifest, which holds those of its files
    config_hash: str
    started_unix_ns: int


def provenance(config: Config, started_unix_ns: int) -> Provenance:
    """Reads files: not for the control path."""
    return Provenance(
        version=__version__,
        python=platform.python_version(),
        platform=platform.platform(),
        packages=_packages(),
        commit=commit_of(Path(__file__).resolve().parent.parent),
        artifact=config.policy.artifact,
        artifact_digest=_digest(config.policy.artifact),
        config_hash=config_hash(config),
        started_unix_ns=started_unix_ns,
    )


def commit_of(folder: Path) -> str | None:
    """The commit that is checked out in ``folder``, read from git's files; None where there is none."""
    try:
        git = folder / ".git"
        if git.is_file():  # a worktree: the file names its folder
            git = (folder / git.read_text(encoding="utf-8").strip().removeprefix("gitdir: ")).resolve()
        head = (git / "HEAD").read_text(encoding="utf-8").strip()
        name = head.removeprefix("ref: ")
        if name == head:
            return head
        common = git / "commondir"
        shared = (git / common.read_text(encoding="utf-8").strip()).resolve() if common.exists() else git
        if (shared / name).exists():
            return (shared / name).read_text(encoding="utf-8").strip()
        for line in (shared / "packed-refs").read_text(encoding="utf-8").splitlines():
            if line.endswith(f" {name}"):
                return line.partition(" ")[0]
    except (OSError, UnicodeDecodeError):
        return None
    return None


def _packages() -> dict[str, str]:
    found = {}
    for name in _ALSO:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _digest(artifact: str) -> str | None:
    try:
        return read_manifest(artifact_folder(artifact))[1]
    except ConfigError:
        return None
