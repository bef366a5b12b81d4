import subprocess

from ambiguous_wild.core.processes import python_command, python_meanwhile


def test_a_started_python_runs_no_module_of_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "random.py").write_text("raise SystemExit('ran a file among the photos')")
    monkeypatch.chdir(tmp_path)
    code = "import random, sys; import ambiguous_wild; open(sys.argv[1], 'w').write('done')"
    subprocess.run(python_command(code, "output.txt"), check=True)
    assert (tmp_path / "output.txt").read_text() == "done"
    with python_meanwhile("import random; open('beside.txt', 'w').write('done')", finish=True):
        pass
    assert (tmp_path / "beside.txt").read_text() == "done"
