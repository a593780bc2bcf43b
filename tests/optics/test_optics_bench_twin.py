import json

from lowfc.programs.measure.bench.twin import bench_twin, render


def test_the_bench_reports_all_three_twins(cache_dir, fast, accurate, broadband):
    names = []
    result = bench_twin(seconds=0.05, progress=names.append, cache_dir=cache_dir)
    assert json.loads(json.dumps(result)) == result
    cases = result["cases"]
    assert [case["name"] for case in cases] == names
    assert [(case["rank"], case["wavelengths"]) for case in cases] == [(60, 1), (80, 1), (60, 3)]
    for key in ("twin_us", "full_us", "ratio", "relative_l2", "rank"):
        assert result[key] == cases[0][key]
    for case, limit in zip(cases, (1e-4, 2e-6, 1e-4), strict=True):
        assert 0 < case["relative_l2"] < limit
        assert case["ratio"] == case["full_us"] / case["twin_us"]
    table = render(result)
    assert all(name in table for name in names)
    assert "sensor sam" in table
