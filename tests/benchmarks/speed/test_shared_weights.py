"""The benchmark of shared weights, with few rows."""


def test_both_ways_are_timed():
    from speed import shared_weights

    row = shared_weights.run(shared_weights.Cell(200, 8))
    assert min(row["shared_seconds"], row["own_seconds"]) > 0.0
    title, _, table, _ = shared_weights.paragraphs([{name: str(value) for name, value in row.items()}])
    assert title == "# One set of weights for all outputs"
    assert "| 200 | 8 |" in table


def test_each_output_has_an_evaluation_of_its_own_without_sharing(monkeypatch):
    from skevgp.model import objectives
    from speed import shared_weights

    calls = []
    call = objectives.BoundObjective.__call__
    monkeypatch.setattr(objectives.BoundObjective, "__call__", lambda self, x: calls.append(len(x)) or call(self, x))
    for share, expected in ((True, 1), (False, shared_weights.N_OUTPUTS)):
        evaluate = shared_weights.evaluations(shared_weights.Cell(200, 8), share)
        calls.clear()
        evaluate()
        assert len(calls) == expected
