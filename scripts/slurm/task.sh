#!/usr/bin/env bash
# Job, or task of a job array: runs a command, passes SIGTERM on to it, and requeues itself if the command exits with 143,
# as splatsieve does after SIGTERM.
#
#     sbatch --requeue --signal=B:TERM@60 --array=1-8 task.sh splatsieve compress ... --shard @TASK@/8 --threads=@THREADS@
#
# These placeholders in words of the command are replaced; a word whose value is unknown is left out:
#     @TASK@     number of the task
#     @THREADS@  processors of the job
#     @MEMORY@   90% of its memory; the rest is for other memory that the system counts for a job, such as file pages
#     @AGAIN@    --overwrite if the job has been started before: it may have ended after writing its result and before
#                its exit. If the result existed before the first start, that start was refused.
# Words are not split or expanded otherwise, so paths may contain spaces.
set -uo pipefail

# Maximum number of requeues. A job that its time limit ends every time would otherwise requeue itself forever.
most=${SPLATSIEVE_RESTARTS:-100}
restarts=${SLURM_RESTART_COUNT:-0}

mib=${SLURM_MEM_PER_NODE:-$((${SLURM_MEM_PER_CPU:-0} * ${SLURM_CPUS_ON_NODE:-1}))}
((mib == 0)) && memory= || memory=$((mib * 9 / 10))MiB
((restarts == 0)) && again= || again=--overwrite
declare -A known=(
    [TASK]=${SLURM_ARRAY_TASK_ID:-} [THREADS]=${SLURM_CPUS_PER_TASK:-${SLURM_CPUS_ON_NODE:-}}
    [MEMORY]=$memory [AGAIN]=$again
)
words=()
for word; do
    if [[ $word =~ @(TASK|THREADS|MEMORY|AGAIN)@ ]]; then
        value=${known[${BASH_REMATCH[1]}]}
        [[ -n $value ]] || continue
        word=${word/"${BASH_REMATCH[0]}"/"$value"}
    fi
    words+=("$word")
done

child='' told=''
trap 'told=1; [[ -z $child ]] || kill -TERM "$child" 2>/dev/null' TERM
"${words[@]}" &
child=$!
[[ -z $told ]] || kill -TERM "$child" 2>/dev/null
# `wait` returns early when a trap runs, so wait again until the child has ended.
while :; do
    told=''
    wait "$child"
    status=$?
    [[ -n $told ]] || break
done
((status == 143)) || exit "$status"

job=${SLURM_ARRAY_JOB_ID:+${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID}
job=${job:-${SLURM_JOB_ID:-}}
[[ -n $job ]] || exit 143
# scancel also sends SIGTERM, and so does a preemption that has requeued the job already; neither needs a requeue.
# The job is named by array number and task number, because the number of the array alone means all its tasks.
state=$(squeue --noheader --states=all --jobs="$job" --format=%T)
[[ $state == RUNNING ]] || exit 143
if ((restarts >= most)); then
    echo "told to end at start $((restarts + 1)), and not put back: is --time too short for one part?" >&2
    exit 1
fi
echo "told to end; back into the queue" >&2
# A requeue ends this script as well.
trap '' TERM
scontrol requeue "$job" && sleep 60
exit 143
