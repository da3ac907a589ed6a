#!/usr/bin/env bash
# A job or a task of an array: runs a command, hands SIGTERM on to it, and puts itself back into the queue when the
# command ends with 143, as splatsieve does when it is told to end.
#
#     sbatch --requeue --signal=B:TERM@60 --array=1-8 task.sh splatsieve compress ... --shard @TASK@/8 --threads=@THREADS@
#
# Of the command's words these are replaced; a word of which nobody knows the value is left out:
#     @TASK@     number of the task
#     @THREADS@  processors of the job
#     @MEMORY@   nine tenths of its memory; the rest is for what the system counts to a job besides, as pages of files
#     @AGAIN@    --overwrite, where the job has been started before: it may have ended between its result and its last
#                word. A result that was there before its first start has refused that one.
# No word is split or expanded otherwise, so paths may hold spaces.
set -uo pipefail

# So often a job puts itself back. One that its own time limit cuts short every time would do so for ever.
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
# A trap ends a wait before the child has ended.
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
# scancel, or a preemption that has put the job back already, tells it to end too. That stays as it is.
# By the array's number and the task's: one of the tasks has the array's own number, which stands for all of them.
state=$(squeue --noheader --states=all --jobs="$job" --format=%T)
[[ $state == RUNNING ]] || exit 143
if ((restarts >= most)); then
    echo "told to end at start $((restarts + 1)), and not put back: is --time too short for one part?" >&2
    exit 1
fi
echo "told to end; back into the queue" >&2
# Putting it back ends this script as well.
trap '' TERM
scontrol requeue "$job" && sleep 60
exit 143
