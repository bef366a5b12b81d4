#!/bin/bash
#SBATCH --nodes=4 --ntasks-per-node=1 --exclusive
#SBATCH --cpus-per-task=32 --gpus-per-task=4 --time=24:00:00
# aw bench on a Slurm cluster, see docs/cluster.md. Needs Ray 2.49 or later; with older Ray use
# `ray start --head` on one node and `ray start --address` on the others.
source /shared/venv/bin/activate
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
ip=$(srun --nodes=1 --ntasks=1 --overlap -w "$head" hostname --ip-address | awk '{print $1}')
srun --nodes="$SLURM_JOB_NUM_NODES" --ntasks="$SLURM_JOB_NUM_NODES" \
    ray symmetric-run --address "$ip:6379" --min-nodes "$SLURM_JOB_NUM_NODES" -- \
    aw bench --method 3dgs --scene /shared/scene \
        -o /shared/runs --engine ray --address "$ip:6379" --device cuda --set engine.cpus_per_cell=8
