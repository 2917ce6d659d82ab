"""The command line: arguments, exit codes, and nothing else, so that it starts fast. `mn_onnx.commands` does the work.

Exit codes: 0 success; 2 wrong usage or a refused model; 3 a check failed or there is no level set; 4 the memory allowed
is not enough; 130 interrupted; 141 whoever read the output went away.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

from mn_onnx import __version__
from mn_onnx.errors import CheckFailed, MemoryLimitReached, MnOnnxError

EXIT_USAGE = 2
EXIT_CHECK = 3
EXIT_MEMORY = 4
EXIT_INTERRUPTED = 130
EXIT_PIPE = 141


class _Parser(argparse.ArgumentParser):
    """A parser that knows numbers as ``-1.``, ``-1e-3`` and ``-1,0`` from options."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?(,.*)?$", re.IGNORECASE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line with ``arguments`` (default: those of the process); returns the exit code."""
    options = build_parser().parse_args(arguments)
    try:
        with _ended_by_interrupts():
            status: int = options.run(options)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read the output has seen enough
        _drop_output()
        return EXIT_PIPE
    except CheckFailed as error:
        _complain(str(error))
        return EXIT_CHECK
    except MemoryLimitReached as error:
        _complain(str(error))
        return EXIT_MEMORY
    except MemoryError as error:
        reason = str(error) or "an allocation failed"
        _complain(f"there is no memory left: {reason}\n  Fix: extract the box in parts with --bounds")
        return EXIT_MEMORY
    except MnOnnxError as error:
        _complain(str(error))
        return EXIT_USAGE
    except KeyboardInterrupt:
        _complain("interrupted")
        return EXIT_INTERRUPTED
    except OSError as error:  # of printing, as files have messages of their own
        _complain(str(error))
        _drop_output()
        return EXIT_USAGE


def _drop_output() -> None:
    """Python would complain once more when it closes the standard output, with what could not be written."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _ended_by_interrupts() -> Iterator[None]:
    """Let a request to end do what an interrupt does, so that nothing half written stays."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []  # only there can handlers be set
    ours = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    for number in ours:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def _extract(options: argparse.Namespace) -> int:
    from mn_onnx.commands import run_extract

    return run_extract(options)


def _inspect(options: argparse.Namespace) -> int:
    from mn_onnx.commands import run_inspect

    return run_inspect(options)


def _verify(options: argparse.Namespace) -> int:
    from mn_onnx.commands import run_verify

    return run_verify(options)


def _bench(options: argparse.Namespace) -> int:
    from mn_onnx.commands import run_bench

    return run_bench(options)


def _complain(message: str) -> None:
    print(f"mn-onnx: {message}", file=sys.stderr)


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; ``options.run`` is the function that carries the command out."""
    parser = _Parser(
        prog="mn-onnx",
        description="Exact level sets of networks exported to ONNX, as welded polygon meshes.",
        epilog="Exit codes: 0 ok, 2 wrong usage or refused model, 3 failed check or empty level set, 4 memory limit "
        "reached, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"mn-onnx {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_extract(commands)
    _add_inspect(commands)
    _add_verify(commands)
    _add_bench(commands)
    return parser


def _add_extract(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "extract",
        help="write the level set of a model as a mesh file",
        description="Extract {x in box | f(x) = level} exactly, check it, and write it. The format follows the ending "
        "of MESH: .ply .obj .off hold polygons, .stl .glb .3mf triangles.",
    )
    parser.set_defaults(run=_extract)
    _add_model(parser)
    parser.add_argument("-o", "--mesh", required=True, metavar="MESH", help="mesh file to write")
    parser.add_argument(
        "--triangulate", action="store_true", help="write triangles where the format could hold polygons"
    )
    parser.add_argument("--float64", action="store_true", help="write coordinates in double precision (.ply)")
    parser.add_argument(
        "--attributes",
        nargs="+",
        default=[],
        choices=("normals", "eps", "displacement"),
        metavar="NAME",
        help="values per face to write (.ply): normals; of smooth networks eps (proved error), displacement",
    )
    parser.add_argument(
        "--polish",
        action="store_true",
        help="move the vertices onto the level set of the true smooth network, and divide faces too coarse for it",
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="one mesh for each row of the tables bound by --bind NAME=codes.npy; MESH may hold {:03d} for the row",
    )
    parser.add_argument("--report", metavar="FILE.json", help="write counts, checks, times and versions as JSON")
    parser.add_argument("--no-check", action="store_true", help="write the mesh without checks against onnxruntime")
    parser.add_argument("--profile", action="store_true", help="print where the time went, on standard error")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    _add_threads(parser)
    _add_max_memory(parser)


def _add_inspect(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "inspect",
        help="say what a model is, before any work",
        description="Exact or not, units, layers, knots, the certified range of the output on the box; or all reasons "
        "why the model would be refused.",
    )
    parser.set_defaults(run=_inspect)
    _add_model(parser)
    parser.add_argument(
        "--stage", choices=("imported", "canonical"), help="print the network as it is after this stage"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def _add_verify(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "verify",
        help="check a mesh file against a model",
        description="Measure the invariants of any mesh file, and |f - level| on it, in float64 and by onnxruntime.",
    )
    parser.set_defaults(run=_verify)
    parser.add_argument("mesh", metavar="MESH", help="mesh file to check")
    _add_model(parser)
    parser.add_argument(
        "--tolerance",
        type=float,
        metavar="T",
        help="largest |f - level| to accept (default: what the rounding of the stored coordinates explains)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    _add_threads(parser)


def _add_bench(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "bench",
        help="measure exact extraction against marching cubes on this machine",
        description="Time, memory and error of exact extraction and of marching cubes (onnxruntime, scikit-image), on "
        "the same threads, each in a fresh process, kernels warm. Needs the extra `bench`.",
    )
    parser.set_defaults(run=_bench)
    parser.add_argument("models", metavar="MODEL", nargs="+", help="ONNX files")
    parser.add_argument(
        "--grids", type=int, nargs="+", metavar="N", help="points per axis of marching cubes (default 64 128 256)"
    )
    parser.add_argument(
        "--repeat", type=int, default=3, metavar="N", help="runs, of which the median counts (default 3)"
    )
    parser.add_argument(
        "--samples", type=int, default=1 << 20, metavar="N", help="points per mesh to measure |f| at (default 2^20)"
    )
    parser.add_argument("--reference", metavar="MESH", help="true shape: measure its mean distance from each mesh too")
    parser.add_argument("--json", metavar="FILE.json", help="write all measurements as JSON")
    parser.add_argument("--plot", metavar="FILE.png", help="draw time against error")
    parser.add_argument("--quiet", action="store_true", help="print no table")
    _add_field(parser)
    _add_threads(parser)
    _add_max_memory(parser)


def _add_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL", help="ONNX file")
    _add_field(parser)


def _add_field(parser: argparse.ArgumentParser) -> None:
    field = parser.add_argument_group("the field")
    field.add_argument("--level", type=float, default=0.0, metavar="L", help="value of the level set (default 0)")
    field.add_argument(
        "--bounds",
        type=float,
        nargs="+",
        metavar="B",
        help="box: LOW HIGH for all axes, or LOW HIGH of each axis in turn (default: the model's metadata, else -1 1)",
    )
    field.add_argument("--output", metavar="NAME[:CHANNEL]", help="output of the model, and which of its values")
    field.add_argument(
        "--bind",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="fix another input: a number, numbers with commas, or a .npy file; repeatable",
    )
    field.add_argument("--row", type=int, metavar="I", help="take row I of the tables that are bound")
    field.add_argument(
        "--sign",
        choices=("auto", "positive-outside", "positive-inside"),
        default="auto",
        help="where the output is larger than the level (default: by the corners of the box)",
    )
    field.add_argument("--coordinates", metavar="I,J,K", help="columns or inputs that are the coordinates, in order")
    smooth = parser.add_argument_group("smooth activations")
    smooth.add_argument(
        "--surrogate-tol", type=float, metavar="T", help="refine surrogates until |f_true - f| is certified at most T"
    )
    smooth.add_argument(
        "--knots-per-period", type=float, metavar="N", help="fineness of surrogates, where no tolerance is given"
    )
    smooth.add_argument(
        "--budget",
        type=float,
        metavar="N",
        help="most polygons; without tolerance or knots surrogates are as fine as it allows (default 2.5e6, up to "
        "1.2e7 where the topology needs them)",
    )


def _add_threads(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--threads", type=int, metavar="N", help="threads to use (default: all cores)")


def _add_max_memory(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--max-memory",
        metavar="SIZE",
        help="stop with an error before the process occupies more, such as 4GiB (default: 80 %% of what is available)",
    )
