"""Running a one-shot verb from the parsed words to its result. Layer: top."""

from __future__ import annotations

import argparse
import logging
import os
import signal
from collections.abc import Callable, Coroutine
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import trio

from mavftpfs import daemon
from mavftpfs.commands import connection_of
from mavftpfs.compose import open_sinks
from mavftpfs.fuse.options import parse_options
from mavftpfs.oneshot.files import Session
from mavftpfs.oneshot.mounted import mountpoint_of
from mavftpfs.oneshot.session import Target
from mavftpfs.shared.errors import UsageError

ResultT = TypeVar("ResultT")
Args = argparse.Namespace


def _target(args: Args, component: int | None) -> Target:
    mount = mountpoint_of(args.source)
    if mount is not None:
        return Target(None, parse_options(args.options), mount=mount)
    if os.path.isdir(args.source):
        raise UsageError(f"no vehicle is mounted on {args.source}")
    options, spec = connection_of(args)
    if component is not None:
        options = replace(options, target_component=component)
    return Target(spec, options)


def run(
    args: Args,
    function: Callable[[Target], Coroutine[Any, Any, ResultT]],
    component: int | None = None,
) -> ResultT:
    """Run a verb; Ctrl-C ends it in order, so that the vehicle's session is closed."""
    target = _target(args, component)
    daemon.log_to_stderr(logging.DEBUG if args.debug else logging.WARNING)
    if not args.debug:  # whatever the caches warn of is raised, too, and errors are one line
        logging.getLogger("mavftpfs.cache").setLevel(logging.ERROR)
    with open_sinks(target.options, debug=args.debug) as sinks:
        return trio.run(until_interrupted, partial(function, replace(target, sinks=sinks)))


def with_session(
    args: Args,
    function: Callable[[Session], Coroutine[Any, Any, ResultT]],
    component: int | None = None,
    *,
    writing: bool = False,
) -> ResultT:
    """Run a verb on the vehicle's files; `writing` if it changes them."""

    async def work(target: Target) -> ResultT:
        async with target.session(writing=writing) as session:
            return await function(session)

    return run(args, work, component)


async def until_interrupted(function: Callable[[], Coroutine[Any, Any, ResultT]]) -> ResultT:
    """Return the function's result.

    Raises:
        KeyboardInterrupt: SIGINT or SIGTERM came first; the function was cancelled and has cleaned up.
        MavftpfsError, OSError: the function's own.
    """
    results: list[ResultT] = []
    errors: list[Exception] = []
    with trio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        async with trio.open_nursery() as nursery:

            async def watch() -> None:
                async for _ in signals:
                    nursery.cancel_scope.cancel()

            nursery.start_soon(watch)
            try:
                results.append(await function())
            except Exception as exc:  # raised again outside of the nursery, which would wrap it in a group
                errors.append(exc)
            nursery.cancel_scope.cancel()
    if errors:
        raise errors[0]
    if not results:
        raise KeyboardInterrupt
    return results[0]
