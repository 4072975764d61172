"""Make runs in processes of their own through submitit: on several devices, or as jobs of a Slurm cluster.

submitit is optional: the extra `cluster`. It is imported only here, and only when it is used. The files of
the jobs and their logs are in `OUT/jobs/RUN`.
"""

from __future__ import annotations

import math
import os
import shutil
import signal
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from neilfpp_method.errors import Stopped, UserError
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.tradeoff.ending import Ending, Report, attempt
from neilfpp_method.tradeoff.machines import visible_gpu
from neilfpp_method.tradeoff.planned_runs import PlannedRun
from neilfpp_method.tradeoff.queue import Job

__all__ = ["LocalProcesses", "SlurmCluster", "make_in_job"]

UNLIMITED = 60 * 24 * 365
"""Time limit of a local process, in minutes; submitit demands one."""
JOB_FACTOR, JOB_MINUTES = 1.5, 30
"""A Slurm job may take this multiple of its budget and so many minutes more, for the start of the program,
the metrics and relit views. `--slurm timeout_min=N` replaces this.
"""
COMMON_PARAMETERS = ("timeout_min", "mem_gb", "cpus_per_task", "gpus_per_node", "name", "stderr_to_stdout")
"""Parameters that submitit has for all clusters."""
SUBMITIT_PARAMETERS = ("setup", "teardown", "srun_args", "use_srun", "signal_delay_s")
"""Parameters of submitit for Slurm that are not options of sbatch."""
STOPPED = "stopped; the same command continues it"

Work = Callable[[PlannedRun, str, Report | None], Ending]
"""What a job computes; another process imports it by its name."""


def make_in_job(run: PlannedRun, device: str, report: Report | None) -> Ending:
    """Make a run in a job. Nothing is raised, so that the cause of every end reaches the command.

    SIGTERM stops the run: within the training it saves the state (`train.stopping`).
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with computing_fast():
            return attempt(run, device, Console(markup=False, highlight=False), report)
    except (Stopped, KeyboardInterrupt):
        return Ending(STOPPED)
    except Exception as error:
        traceback.print_exc()
        return Ending(f"{type(error).__name__}: {error}; see {_own_log()}")


class LocalProcesses:
    """One run at a time on each of several devices of this machine.

    submitit's local executor has no limit of its own for the number of processes; the queue starts only as
    many as there are devices.
    """

    def __init__(
        self, devices: Sequence[str], out: Path, report: Report | None, work: Work = make_in_job
    ) -> None:
        self._submitit = _library("several devices")
        self._devices = {f"{name} ({k})" if name == "cpu" else name: name for k, name in enumerate(devices)}
        self.places = tuple(self._devices)
        self._out, self._report, self._work = out, report, work

    def start(self, run: PlannedRun, place: str) -> Job:
        """Start a process that sees only the GPU of its place, under the name `cuda`."""
        executor = self._submitit.LocalExecutor(_new_folder(self._out, run))
        device, gpus = self._devices[place], {}
        if device != "cpu":
            gpus = {"gpus_per_node": 1, "visible_gpus": (visible_gpu(device),)}
            device = "cuda"
        executor.update_parameters(timeout_min=UNLIMITED, **gpus)
        with _interrupts_blocked():
            return _LocalJob(executor.submit(self._work, run, device, self._report))


class SlurmCluster:
    """Jobs of a Slurm cluster, all submitted at once.

    Raises:
        UserError: if there is no Slurm.
    """

    def __init__(
        self,
        parameters: Mapping[str, object],
        device: str,
        runs: int,
        out: Path,
        report: Report | None,
        work: Work = make_in_job,
    ) -> None:
        self._submitit = _library("--slurm")
        if shutil.which("srun") is None:
            raise UserError("--slurm: no command srun here", "start neilfpp on a machine of a Slurm cluster")
        self.places = tuple(f"Slurm ({k})" for k in range(1, runs + 1))
        self._device, self._out, self._report, self._work = device, out, report, work
        self._parameters = _slurm_parameters(parameters)

    def start(self, run: PlannedRun, place: str) -> Job:
        """Submit a job.

        Raises:
            UserError: if submitit or sbatch refuses the parameters.
        """
        executor = self._submitit.AutoExecutor(_new_folder(self._out, run), cluster="slurm")
        timeout = math.ceil(JOB_FACTOR * run.budget / 60) + JOB_MINUTES
        try:
            executor.update_parameters(**{"name": run.name, "timeout_min": timeout, **self._parameters})
            job = executor.submit(self._work, run, self._device, self._report)
        except Exception as error:
            # submitit raises errors of many types, with the message of sbatch among them.
            raise UserError(f"--slurm: the job was not submitted: {error}", "change --slurm") from error
        return _SlurmJob(job)


def _slurm_parameters(parameters: Mapping[str, object]) -> dict[str, object]:
    """Parameters as `AutoExecutor` takes them: its own names, those with the prefix of Slurm, and all others
    as options of sbatch.
    """
    sbatch = {
        name.replace("_", "-"): value
        for name, value in parameters.items()
        if name not in (*COMMON_PARAMETERS, *SUBMITIT_PARAMETERS)
    }
    return {
        **{name: value for name, value in parameters.items() if name in COMMON_PARAMETERS},
        **{f"slurm_{name}": value for name, value in parameters.items() if name in SUBMITIT_PARAMETERS},
        "slurm_additional_parameters": sbatch,
    }


class _LocalJob:
    """A process and its controller, whose id is that of the job."""

    def __init__(self, job: Any) -> None:
        self._job = job

    def done(self) -> bool:
        return self._job.done()

    def ending(self) -> Ending:
        return _ending(self._job)

    def stop(self) -> None:
        if not self.done():
            # The controller passes SIGTERM on. submitit's own `cancel` kills the process after a second.
            os.kill(int(self._job.job_id), signal.SIGTERM)


class _SlurmJob:
    def __init__(self, job: Any) -> None:
        self._job = job
        self._cancelled = False

    def done(self) -> bool:
        # The state of a cancelled job reaches submitit late.
        return self._cancelled or self._job.done()

    def ending(self) -> Ending:
        return _ending(self._job)

    def stop(self) -> None:
        if not self.done():
            self._job.cancel(check=False)
            self._cancelled = True


def _ending(job: Any) -> Ending:
    """How a job ended, also if it was killed."""
    try:
        return job.result()
    except Exception as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        cause = lines[0] if lines else type(error).__name__
        return Ending(f"the process ended without a result ({cause}); see {job.paths.stderr}")


def _own_log() -> Path:
    import submitit

    return submitit.JobEnvironment().paths.stderr


def _new_folder(out: Path, run: PlannedRun) -> Path:
    """An empty folder for the files of a job. Those of an earlier job could be taken for its result."""
    folder = out / "jobs" / run.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C for processes that are started in the context. The terminal sends it to all processes, and
    submitit's controller would kill its process a second later.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _library(purpose: str) -> Any:
    try:
        import submitit
    except ImportError as error:
        raise UserError(
            f"{purpose}: submitit is not installed",
            "pip install 'neilfpp-method[cluster]', or train on one device",
        ) from error
    return submitit
