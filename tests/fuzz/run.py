"""Feed a door with coverage-guided inputs: `python tests/fuzz/run.py TARGET RUNS [atheris options]`.

Prints the resident memory after a tenth of the runs and at the end, in KiB; an input that raises ends it with a
traceback, and libFuzzer writes it to crash-* beside the
corpus-TARGET that it works on.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import atheris

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
with atheris.instrument_imports(include=["companion"]):
    from targets import TARGETS, seeds


def main() -> None:
    name, runs, *options = sys.argv[1:]
    one_input, total = TARGETS[name](), int(runs)
    seen = 0

    def counted(data: bytes) -> None:
        nonlocal seen
        one_input(data)
        seen += 1
        if seen in (max(total // 10, 1), total - 1):
            print(f"memory {name} {seen} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}", flush=True)

    corpus = Path(f"corpus-{name}")  # of the working directory: libFuzzer leaves without any cleaning up
    corpus.mkdir(exist_ok=True)
    for index, seed in enumerate(seeds(name)):
        (corpus / f"seed-{index}").write_bytes(seed)
    flags = [f"-runs={total}", "-seed=1", "-max_len=4096", "-rss_limit_mb=0"]
    atheris.Setup([sys.argv[0], *flags, *options, str(corpus)], counted)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
