import io
import re
import tarfile
import threading
from functools import partial
from hashlib import sha256
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from skevgp.datasets import fetch_snelson, snelson

X, Y, TEST = np.array([2.5, 0.25, 1.0]), np.array([-1.0, 0.125, 3.0]), np.array([-3.0, 10.0])
FAKE = {"train_inputs": X, "train_outputs": Y, "test_inputs": TEST}


TRUE_CHECKSUMS = snelson._CHECKSUMS


def text(values, end="\n"):
    return "".join(f"  {value:.7e}{end}" for value in values).encode()


def archive(contents, kind="w:gz"):
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode=kind) as members:
        for name, content in contents.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            members.addfile(member, io.BytesIO(content))
    return stream.getvalue()


GOOD = {f"SPGP_dist/{name}": text(values) for name, values in FAKE.items()}


@pytest.fixture(autouse=True)
def fake_checksums(monkeypatch):
    checksums = {name: sha256(values.tobytes()).hexdigest() for name, values in FAKE.items()}
    monkeypatch.setattr(snelson, "_CHECKSUMS", checksums)


@pytest.fixture
def home(tmp_path):
    return tmp_path / "home"


@pytest.fixture
def fetch(home):
    return partial(fetch_snelson, home, n_retries=0)


@pytest.fixture
def serve(tmp_path, monkeypatch):
    """Put bytes where the archive is looked for."""

    def serve(content):
        path = tmp_path / "archive.tgz"
        path.write_bytes(content)
        monkeypatch.setattr(snelson, "_ADDRESS", path.as_uri())
        return path

    return serve


@pytest.fixture
def offline(monkeypatch):
    def refuse(*_arguments, **_options):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(snelson, "urlopen", refuse)


def put(folder, ending="", end="\n", **changed):
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in {**FAKE, **changed}.items():
        (folder / f"{name}{ending}").write_bytes(text(values, end))


def test_target_is_the_papers(fetch, serve):
    serve(archive(GOOD))
    toy = fetch()
    assert set(toy) == {"data", "target", "test_data", "feature_names", "target_names", "DESCR"}
    assert_array_equal(toy.data, X[:, np.newaxis])
    assert_array_equal(toy.target, 6.0 * Y + 3.0 * X)
    assert_array_equal(toy.test_data, TEST[:, np.newaxis])
    assert (toy.feature_names, toy.target_names) == (["x"], ["y"])
    assert "6 y + 3 x" in toy.DESCR


def test_folder_that_lacks_a_file_is_not_enough(serve, fetch, home):
    put(home / "SPGP_dist")
    (home / "SPGP_dist" / "test_inputs").unlink()
    with pytest.raises(OSError, match="download_if_missing is False"):
        fetch(download_if_missing=False)
    serve(archive(GOOD))
    assert_array_equal(fetch().test_data, TEST[:, np.newaxis])


def test_without_permission_nothing_is_downloaded(offline, fetch, home):
    with pytest.raises(OSError, match=rf"neither in {re.escape(str(home))} nor in .*SPGP_dist.*train_inputs.*http"):
        fetch(download_if_missing=False)


def test_invalid_numbers_in_a_folder_raise(offline, fetch, home):
    put(home, ".dat", train_outputs=2.0 * Y)
    found = sha256((2.0 * Y).tobytes()).hexdigest()
    expected = sha256(Y.tobytes()).hexdigest()
    with pytest.raises(OSError, match=rf"train_outputs\.dat .*checksum is {found}, expected {expected}"):
        fetch()


def test_file_without_numbers_raises(offline, fetch, home):
    put(home)
    (home / "test_inputs").write_text("<html>moved</html>")
    with pytest.raises(OSError, match="test_inputs .* is not a list of numbers"):
        fetch()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"<html>moved</html>", "not a gzip file"),
        (archive(GOOD)[:-60], "end-of-stream"),
        (archive(GOOD, "w"), "not a gzip file"),
        (archive({**GOOD, "SPGP_dist/test_inputs": text(X)}), "SPGP_dist/test_inputs are not Snelson's.*, expected"),
        (archive({**GOOD, "SPGP_dist/test_inputs": b"1.0 x"}), "SPGP_dist/test_inputs is not a list of numbers"),
        (archive({"SPGP_dist/train_inputs": text(X)}), "the archive has no file SPGP_dist/train_outputs"),
        (archive({f"../{name}": content for name, content in GOOD.items()}), "has no file SPGP_dist/train_inputs"),
        (archive({}), "the archive has no file"),
    ],
    ids=["page", "truncated", "not compressed", "wrong", "no numbers", "missing", "elsewhere", "empty"],
)
def test_invalid_archive_is_told_and_leaves_nothing(fetch, serve, home, content, reason):
    path = serve(content)
    with pytest.raises(OSError, match=rf"could not be fetched from {re.escape(path.as_uri())} \(.*{reason}.*data_home"):
        fetch()
    assert list(home.iterdir()) == []


@pytest.fixture
def server(monkeypatch):
    """Refuses as often as told, then gives the archive; counts its calls."""

    class Handler(BaseHTTPRequestHandler):
        failures = calls = 0

        def do_GET(self):
            Handler.calls += 1
            self.send_response(503 if Handler.calls <= Handler.failures else 200)
            self.end_headers()
            self.wfile.write(archive(GOOD))

        def log_message(self, *_arguments):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        monkeypatch.setattr(snelson, "_ADDRESS", f"http://127.0.0.1:{server.server_port}/SPGP_dist.tgz")
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield Handler
        server.shutdown()
        thread.join()


def test_server_that_stumbles_is_asked_again(server, home):
    server.failures = 2
    assert_array_equal(fetch_snelson(home, n_retries=2, delay=0.0).target, 6.0 * Y + 3.0 * X)
    fetch_snelson(home)
    assert server.calls == 3


def test_server_that_fails_raises(server, home):
    server.failures = 9
    with pytest.raises(OSError, match=r"fetched from http://127.0.0.1:\d+/SPGP_dist.tgz \(HTTP Error 503.*data_home"):
        fetch_snelson(home, n_retries=1, delay=0.0)
    assert server.calls == 2


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"n_retries": -1}, ValueError, "n_retries must be at least 0; got -1"),
        ({"n_retries": 1.5}, TypeError, "n_retries must be an integer; got 1.5"),
        ({"delay": -1.0}, ValueError, "delay must be finite and at least 0.0; got -1.0"),
        ({"data_home": 3}, ValueError, "data_home"),
    ],
)
def test_invalid_arguments_raise(arguments, error, message):
    with pytest.raises(error, match=message):
        fetch_snelson(**arguments)


def test_other_numbers_in_the_same_files_are_not_snelsons(monkeypatch, offline, fetch, home):
    """Against the checksums of the true files, which are not ours to ship."""
    monkeypatch.setattr(snelson, "_CHECKSUMS", TRUE_CHECKSUMS)
    put(home, ".dat")
    with pytest.raises(OSError, match=r"train_inputs\.dat .*are not Snelson's.*expected 8b1ccec3"):
        fetch()
