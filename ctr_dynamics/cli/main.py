"""The `ctr-dynamics` command: finds the command's file, runs it and turns its outcome into an exit code."""

from __future__ import annotations

import functools
import inspect
import os
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from importlib import import_module
from importlib.util import find_spec
from keyword import iskeyword
from types import FrameType
from typing import Annotated, Any, TextIO

import typer

from ctr_dynamics import __version__
from ctr_dynamics.errors import InputError
from ctr_dynamics.one_blas_thread import one_blas_thread

# Shown by --help without importing the command's file.
COMMANDS = {
    "replay": "Run a recorded bag through the estimator, without a ROS graph.",
    "diagnose": "Find what the simulation gets wrong about the recorded robot.",
    "simulate": "Write a bag of a simulated scenario.",
    "align": "Find clock offset, latency, registration and mount between tracker and joints.",
    "calibrate": "Fit a robot file to measured tips, judged on held-out ones.",
    "evaluate": "Compare a replay's outputs with the truth of a simulated robot.",
    "statics": "Solve the static model for a table of actuator positions.",
    "snap": "Snap-through by the finite-difference solver.",
    "import": "Write CSV logs of actuators and tracker as a bag.",
    "robot": "Write a robot file from data sheets, check one, or write its URDF.",
    "view": "Serve a bag or the live topics to Foxglove.",
    "bench": "Measure cost per step, real-time ratios and tick times.",
    "info": "Say what is in a bag: topics, rates, gaps, clock and unit problems.",
    "warmup": "Compile the kernels of estimator and diagnosis into the cache.",
    "demo": "Estimator node and driver live over DDS on a shipped bag.",
}

# Options of commands that take several values.
MANY = {"diagnose": ("--validate",)}

FINISHED, PARTLY_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def _attribute(name: str) -> str:
    """Name of a command's file and function: a word of Python's own gets an underscore."""
    return f"{name}_" if iskeyword(name) else name


def available() -> list[str]:
    """Commands whose file exists, in the order of COMMANDS."""
    return [name for name in COMMANDS if find_spec(f"ctr_dynamics.cli.{name}_command") is not None]


def fail(message: str) -> None:
    """One line on stderr."""
    print(f"ctr-dynamics: error: {' '.join(message.split())}", file=sys.stderr)


def _with_exit_code(command: Callable[..., Any]) -> Callable[..., None]:
    options = _options(command)

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            code = command(options(*args, **kwargs)) if options is not None else command(*args, **kwargs)
        except InputError as error:
            fail(str(error))
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            fail("interrupted")
            raise typer.Exit(INTERRUPTED) from None
        except BrokenPipeError:
            _discard_output()  # its reader is gone
            raise typer.Exit(FINISHED) from None
        except OSError as error:
            fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
            raise typer.Exit(BAD_INPUT) from None
        if code:
            raise typer.Exit(int(code))

    # typer reads annotations through the signature, and strings in them need the command's own module.
    signature = _signature(command)
    run.__signature__ = signature  # type: ignore[attr-defined]
    run.__annotations__ = {name: p.annotation for name, p in signature.parameters.items()}
    return run


def _options(command: Callable[..., Any]) -> type | None:
    """The data class whose fields are a command's options; None where the options are its arguments."""
    kinds = [p.annotation for p in inspect.signature(command, eval_str=True).parameters.values()]
    return kinds[0] if len(kinds) == 1 and isinstance(kinds[0], type) and is_dataclass(kinds[0]) else None


def _signature(command: Callable[..., Any]) -> inspect.Signature:
    """What typer is to read: the command's arguments, or the fields of its data class of options."""
    return inspect.signature(_options(command) or command, eval_str=True)


def _not_imported() -> None:
    raise AssertionError("a command was run whose file was not imported")


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"ctr-dynamics {__version__}")
        raise typer.Exit


def build_app(requested: str | None) -> typer.Typer:
    """The application with the file of `requested` imported and the other commands listed by name only."""
    app = typer.Typer(
        name="ctr-dynamics",
        help="Dynamics and state estimation of concentric tube robots.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @app.callback()
    def options(
        version: Annotated[
            bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        pass

    for name in available():
        if name == requested:
            module = import_module(f"ctr_dynamics.cli.{name}_command")
            command = getattr(module, _attribute(name))
            if isinstance(command, dict):  # of subcommands
                group = typer.Typer(help=COMMANDS[name], no_args_is_help=True)
                for part, function in command.items():
                    group.command(part)(_with_exit_code(function))
                app.add_typer(group, name=name)
            else:
                app.command(name)(_with_exit_code(command))
        else:
            app.command(name, help=COMMANDS[name])(_not_imported)
    return app


def spread(arguments: list[str], options: Sequence[str]) -> list[str]:
    """Options that take every value up to the next option, as one option a value: the parser knows only that."""
    out: list[str] = []
    current = ""
    for argument in arguments:
        if argument.startswith("-") and argument != "-":
            current = argument if argument in options else ""
            if not current:
                out.append(argument)
        elif current:
            out += [current, argument]
        else:
            out.append(argument)
    return out


def _discard_output() -> None:
    """Nothing more can be written, not even at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _interrupt_on_termination() -> None:
    """Have SIGTERM end a command as Ctrl-C does, so that it leaves no parts of files behind."""
    process = os.getpid()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if os.getpid() != process:  # a worker that was forked later
            os._exit(128 + number)
        fail("terminated")
        raise SystemExit(
            INTERRUPTED
        )  # a KeyboardInterrupt inside an import would have Python kill itself at exit

    signal.signal(signal.SIGTERM, interrupt)


def _unwritable(error: OSError) -> int:
    fail(f"standard output cannot be written ({error.strerror})")
    _discard_output()
    return BAD_INPUT


def _misused(error: Exception) -> int:
    """One line on arguments that are no command's; other errors go on.

    The parser's errors have no class of one name over the versions of typer.
    """
    if not hasattr(error, "format_message"):
        raise error
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        print(context.get_help() if context else error.format_message())
        return BAD_INPUT
    path = context.command_path if context else "ctr-dynamics"
    fail(f"{error.format_message().rstrip('.')}; see `{path} --help`")
    return BAD_INPUT


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """The package's own warnings in one line; others as Python shows them."""
    if category.__module__.startswith("ctr_dynamics"):
        print(f"ctr-dynamics: warning: {message}", file=sys.stderr)
    else:
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno))


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments without the program's name; None takes the process's.

    Returns:
        0 finished, 1 finished but some rows or steps failed or next to nothing was estimated, 2 bad input,
        130 interrupted or terminated.
    """
    for stream in (sys.stdout, sys.stderr):
        # terminals of few characters, and names of files that are not UTF-8
        getattr(stream, "reconfigure", lambda **_: None)(errors="backslashreplace")
    one_blas_thread()
    if argv is None:
        _interrupt_on_termination()
    arguments = sys.argv[1:] if argv is None else argv
    requested = next((a for a in arguments if not a.startswith("-")), None)
    arguments = spread(arguments, MANY.get(requested or "", ()))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            returned = build_app(requested)(args=arguments, prog_name="ctr-dynamics", standalone_mode=False)
        code = returned if isinstance(returned, int) else FINISHED
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else (FINISHED if end.code is None else BAD_INPUT)
    except (KeyboardInterrupt, typer.Abort):
        fail("interrupted")
        return INTERRUPTED
    except OSError as error:
        return _unwritable(error)
    except Exception as error:
        code = _misused(error)
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard_output()
    except OSError as error:
        return _unwritable(error)
    return code


if __name__ == "__main__":
    sys.exit(main())
