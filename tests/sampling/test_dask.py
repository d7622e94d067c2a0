"""A real Dask scheduler and real workers on loopback give what one process gives."""

import json
import os
import sys
from pathlib import Path

import pytest
from oracles.commands import changed
from oracles.dask_processes import Processes, both_workers
from oracles.helpers import problem
from test_parallel import TaskFailure, failing, square, whereabouts
from test_sampling import THETAS, TWO_MASS, X, table

from ccd_casadi.extensions.cluster import dask_pool as module
from ccd_casadi.extensions.cluster.dask_pool import Cluster, ClusterOptions
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.solve import main
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers


@pytest.mark.slow
def test_rows_are_those_of_the_serial_run(shared: Processes, tmp_path: Path) -> None:
    found = []
    for name, pool in (("serial", Workers(1)), ("dask", Cluster(shared.address))):
        with SampleStore(tmp_path / name) as store, pool as workers:
            sampler = Sampler(problem(), store, workers)
            bandwidths = sampler.values(THETAS)
            quantities = sampler.quantities(X)
        bits = [(sample.values.tobytes(), sample.gradients.tobytes()) for sample in quantities]
        found.append((bandwidths, bits, sampler.syntheses, table(tmp_path / name)))
    assert found[0] == found[1]
    assert len(found[0][3]["samples"]) > 50


@pytest.mark.slow
def test_a_solve_on_a_cluster_is_the_solve_on_one_worker(shared: Processes, tmp_path: Path) -> None:
    """Result, controller, surrogate and rows, to the last bit."""
    quick = "\n[sampling]\nlifted_points = 12\n[outer]\nbox_points = 4\nmax_refinements = 0\n"
    words = [str(changed(tmp_path, more=quick)), "--formulation", "lifted", "--quiet"]
    words += ["--no-report", "--out"]
    one, folder = tmp_path / "one", tmp_path / "cluster"
    assert main([*words, str(one), "--workers", "1"]) in (0, 4)
    assert main([*words, str(folder), "--scheduler", shared.address]) in (0, 4)
    here, there = (json.loads((f / "result.json").read_text()) for f in (one, folder))
    assert here.pop("seconds") > 0.0 < there.pop("seconds")
    assert here.pop("phase_seconds").keys() == there.pop("phase_seconds").keys()
    assert here == there
    for name in ("controller.json", "surrogate.json", "case.toml"):
        assert (one / name).read_bytes() == (folder / name).read_bytes()
    assert table(one / "samples.sqlite") == table(folder / "samples.sqlite")


def test_every_task_gives_its_result_once(shared: Processes) -> None:
    with Cluster(shared.address) as cluster:
        both_workers(cluster)
        assert cluster.count == 2
        for tasks in (0, 1, 2, 23):
            found = sorted(cluster.map_unordered(square, range(tasks)))
            assert found == [i * i for i in range(tasks)]
        places = list(cluster.map_unordered(whereabouts, range(12)))
    assert os.getpid() not in {pid for pid, _, _ in places}
    assert {threads for _, _, threads in places} == {1}, "one BLAS thread each"


def test_an_exception_reaches_the_caller(shared: Processes) -> None:
    with Cluster(shared.address) as cluster:
        with pytest.raises(TaskFailure, match="at three") as caught:
            list(cluster.map_unordered(failing, range(40)))
        assert "in a worker process" in caught.value.__notes__[0]
        first = cluster.map_unordered(square, range(5))
        next(first)
        with pytest.raises(RuntimeError, match="busy with another map"):
            next(cluster.map_unordered(square, range(5)))
        first.close()
        assert sorted(cluster.map_unordered(square, [1, 2])) == [1, 4]


def test_a_worker_with_other_numerics_is_refused(
    shared: Processes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "NUMERICS", -1)
    with Cluster(shared.address) as cluster, pytest.raises(UserError, match="same version"):
        list(cluster.map_unordered(square, range(5)))


@pytest.mark.slow
def test_tls_by_the_settings_of_dask(tmp_path: Path) -> None:
    """The certificate is made with the command `openssl`."""
    import dask
    import distributed  # noqa: F401  # its settings must be there before they are changed

    processes = Processes(tmp_path)
    settings = processes.use_tls()
    try:
        processes.start()
        with dask.config.set(settings), Cluster(processes.address) as cluster:
            assert sorted(cluster.map_unordered(square, range(5))) == [0, 1, 4, 9, 16]
        for address in (processes.address, processes.address.replace("tls", "tcp")):
            with pytest.raises(UserError, match="no Dask scheduler answers there"):
                Cluster(address, options=ClusterOptions(connect=1.0)).__enter__()
    finally:
        processes.kill()


def reported(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr of a command that ends with 2 and leaves nothing behind."""
    code = main([str(TWO_MASS), "--out", str(tmp_path / "o"), "--scheduler", address])
    output, errors = capsys.readouterr()
    assert (code, output, errors.count("\n")) == (2, "", 1), errors
    assert not (tmp_path / "o" / "samples.sqlite").exists()
    return errors


@pytest.mark.parametrize("address", ["", "here", "tcp://127.0.0.1", "127.0.0.1:8786"])
def test_what_is_no_address_is_reported(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = reported(address, tmp_path, capsys)
    assert words.startswith(f"--scheduler {address}: is not an address; give what `dask")


@pytest.mark.parametrize("kind", ["tcp://127.0.0.1:{}", "tcp://127.0.0.1:99999", "carrier://a:{}"])
def test_an_address_where_nothing_answers_is_reported(kind: str, tmp_path: Path) -> None:
    address = kind.format(Processes(tmp_path).port)
    words = rf"--scheduler {address}: no Dask scheduler answers there \(.+\); start"
    with pytest.raises(UserError, match=words):
        Cluster(address, options=ClusterOptions(connect=0.3)).__enter__()


def test_without_dask_the_remedy_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    words = reported("tcp://127.0.0.1:8786", tmp_path, capsys)
    assert "Dask, which is not installed; run: python -m pip install dask distributed" in words
