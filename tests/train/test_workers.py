"""Running a mission's trainings: retries, seeds, packing."""

import signal
from dataclasses import asdict
from pathlib import Path

from mjcollect.learning.config import LearnConfig
from train.jobs.workers import Done, Job, attempt_seed, pack, run_jobs, settings_arguments, unpack


class Fake:
    """Workers that finish jobs in reverse order of submission."""

    def __init__(self):
        self.waiting, self.submitted = [], []

    def submit(self, job):
        self.waiting.append(job)
        self.submitted.append(job)

    def next_done(self, timeout):
        return Done(self.waiting.pop(), 0, "")

    def stop(self):
        pass


def job(index, *arguments):
    return Job(index, arguments, Path("nowhere"))


def test_every_job_and_every_retry_runs():
    fake = Fake()

    def retry(done):
        return job(done.job.index, "again") if not done.job.arguments else None

    assert run_jobs(fake, [job(0), job(1), job(2)], retry)
    assert sorted((j.index, j.arguments) for j in fake.submitted) == [
        (k, a) for k in range(3) for a in [(), ("again",)]
    ]


def test_a_stop_leaves_the_rest():
    fake = Fake()
    assert not run_jobs(fake, [job(0), job(1)], lambda done: signal.raise_signal(signal.SIGINT))
    assert len(fake.waiting) == 1


def test_seeds_differ_by_mission_segment_and_attempt():
    seeds = {attempt_seed(s, k, a) for s in range(5) for k in range(10) for a in range(3)}
    assert len(seeds) == 150
    assert attempt_seed(1, 2, 0) == attempt_seed(1, 2, 0)


def test_settings_survive_the_command_line():
    import tyro

    from train.segment import Args

    config = LearnConfig(updates=7, noise_max=0.123456789012345, observation="paper")
    assert tyro.cli(Args, args=settings_arguments(asdict(config))).learn == config


def test_a_packed_folder_unpacks_the_same(tmp_path):
    (tmp_path / "a" / "deep").mkdir(parents=True)
    (tmp_path / "a" / "deep" / "x").write_bytes(b"\x00\x01")
    unpack(pack(tmp_path / "a"), tmp_path / "b")
    assert (tmp_path / "b" / "deep" / "x").read_bytes() == b"\x00\x01"
    (tmp_path / "a" / "deep" / "x").rename(tmp_path / "a" / "y")
    unpack(pack(tmp_path / "a"), tmp_path / "b")  # in its place: nothing of the old one stays
    assert sorted(path.name for path in tmp_path.glob("b/**/*")) == ["deep", "y"]
    unpack(pack(tmp_path / "missing"), tmp_path / "c")
    assert not (tmp_path / "c").exists()
