from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skipgs_plug.bench.decisions import packed, read_decisions, unpacked, write_decisions
from skipgs_plug.bench.record import REASON_CODES, RunRecord, Trace
from skipgs_plug.trainer import InputError

LETTERS = "".join(REASON_CODES.values()) + "".join(REASON_CODES.values()).upper()


def test_every_decision_of_every_run_comes_back(finished, tmp_path):
    path = tmp_path / "decisions.json"
    write_decisions(path, finished.records)
    traces = read_decisions(path)
    assert set(traces) == {(record.seed, record.policy) for record in finished.records}
    for record in finished.records:
        trace = traces[record.seed, record.policy]
        whole = record.trace
        assert (trace.start, trace.view, trace.codes) == (whole.start, whole.view, whole.codes)
        assert trace.skipped == whole.skipped and sum(trace.skipped) == record.skips


def test_runs_that_did_not_finish_are_left_out(finished, tmp_path):
    path = tmp_path / "decisions.json"
    write_decisions(path, [finished.run("gate"), RunRecord(0, "random", "diverged", "loss nan"), RunRecord(7, "gate")])
    assert set(read_decisions(path)) == {(0, "gate")}
    write_decisions(path, [])
    assert read_decisions(path) == {}


def test_iterations_that_were_left_out_have_no_view(tmp_path):
    records = [
        RunRecord(0, "own", trace=Trace(10, [3, 1, 2, 0], codes="----")),
        RunRecord(0, "refine_share=0.4", trace=Trace(10, [3, None, None, 1], codes="-..-")),
    ]
    write_decisions(tmp_path / "decisions.json", records)
    traces = read_decisions(tmp_path / "decisions.json")
    assert [traces[0, record.policy] for record in records] == [record.trace for record in records]


def test_a_long_bench_stays_small(tmp_path):
    """Seven policies, three seeds, 1,500 iterations of 255 views, no two decisions in a row alike."""
    codes = "dDbD" * 375
    view = [7 * i % 255 for i in range(len(codes))]
    trace = Trace(1500, view, codes=codes)
    records = [RunRecord(seed, f"policy {i}", trace=trace) for seed in range(3) for i in range(7)]
    write_decisions(tmp_path / "decisions.json", records)
    assert (tmp_path / "decisions.json").stat().st_size < 60_000


@given(st.text(LETTERS, max_size=60))
def test_packing_loses_nothing_and_is_never_longer(codes):
    assert unpacked(packed(codes)) == codes
    assert len(packed(codes)) <= len(codes)


def test_packed_letters_are_as_documented():
    assert packed("w" * 34 + "dDDDb") == "w34dD3b"


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"kind": "skipgs-decisions", "schema_version": 2, "runs": {}}',
     json.dumps({"kind": "skipgs-decisions", "schema_version": 1, "start": 0, "views": {"0": "0 1"},
                 "runs": {"0": {"gate": "3w"}}}),
     json.dumps({"kind": "skipgs-decisions", "schema_version": 1, "start": 0, "views": {"0": "0 1"},
                 "runs": {"0": {"gate": "w3"}}})],
)  # fmt: skip
def test_unusable_files_are_named(tmp_path, content):
    path = tmp_path / "decisions.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"decisions.json holds no decisions"):
        read_decisions(path)
