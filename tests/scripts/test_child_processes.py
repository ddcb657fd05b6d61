"""A script that runs on CPU stand-ins spawns processes, which import the script: they get the stand-ins first."""

from multiprocessing import spawn

import pytest

from skipgs_plug.compat import serve
from skipgs_plug.scripts.cuda_redirect import cuda_on_cpu, exclusive_cores
from skipgs_plug.scripts.launch import run_script

SCRIPT = """
import multiprocessing, sys
from concurrent.futures import ProcessPoolExecutor
import torch
from simple_knn._C import distCUDA2

def in_a_process(method, others):
    if others:
        with ProcessPoolExecutor(1, multiprocessing.get_context(method)) as pool:
            return pool.submit(in_a_process, method, others - 1).result(timeout=100)
    distances = distCUDA2(torch.eye(4, 3).cuda())
    return distances.device.type, len(distances), torch.get_num_threads(), sys.argv[1:], __name__

if __name__ == "__main__":
    print(in_a_process(sys.argv[1], int(sys.argv[2])))
"""


@pytest.mark.parametrize(("method", "generations"), [("spawn", 2), ("forkserver", 1)])
def test_a_process_imports_the_script_with_its_stand_ins(tmp_path, capfd, method, generations):
    script = tmp_path / "train.py"
    script.write_text(SCRIPT)
    before = spawn.get_preparation_data
    with serve("inria"), cuda_on_cpu(), exclusive_cores():
        code = run_script([str(script), method, str(generations)])
    output = capfd.readouterr()
    assert code == 0, output.err
    assert output.out == f"('cpu', 4, 1, ['{method}', '{generations}'], '__mp_main__')\n"
    assert spawn.get_preparation_data is before
