"""Private Slurm: munged, slurmctld and several slurmd on one machine in one folder, stopped with all their jobs."""

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "scancel", "sinfo")
# Folders of the daemons in Debian, which may be missing in a user's PATH.
PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])

# Short times for tests: a node that is silent for 10 s is down; a requeued job starts after cred_expire.
CONF = """
ClusterName=splatsieve
SlurmctldHost={host}(127.0.0.1)
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=6
SlurmUser={user}
SlurmdUser={user}
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
DefMemPerCPU=2000
SchedulerType=sched/backfill
SchedulerParameters=bf_interval=1,sched_interval=1,batch_sched_delay=0
JobRequeue=1
ReturnToService=2
KillWait=2
SlurmdTimeout=10
SlurmctldTimeout=10
MinJobAge=3600
SlurmdParameters=config_overrides
SlurmctldPort={port}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/log/slurmctld
SlurmdLogFile={folder}/log/slurmd.%n
{nodes}
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
SlurmctldParameters=preempt_send_user_signal
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP PriorityTier=1 GraceTime=10
PartitionName=urgent Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=9 PreemptMode=OFF
"""


def missing():
    """Returns the programs of Slurm and MUNGE that this machine lacks."""
    return [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]


def free_ports(count):
    """Returns ports on which nothing listens now."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


class Cluster:
    """Cluster of `nodes` nodes with one processor each, used as `with Cluster(4) as cluster:`."""

    def __init__(self, nodes):
        self.names = [f"n{k + 1}" for k in range(nodes)]

    def __enter__(self):
        # The path of a socket has at most 107 bytes.
        self.folder = Path(tempfile.mkdtemp(prefix="slurm.", dir="/tmp"))
        self.daemons = {}
        try:
            self.start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        for name in reversed(list(self.daemons)):
            self.stop(name)
        for pid in self.of_jobs():
            end(pid, signal.SIGKILL)
        shutil.rmtree(self.folder, ignore_errors=True)

    def start(self):
        for name in ("state", "log", "spool", *(f"spool/{name}" for name in self.names)):
            (self.folder / name).mkdir()
        host = socket.gethostname().split(".")[0]
        port, *ports = free_ports(1 + len(self.names))
        nodes = [
            f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={at} CPUs=1 RealMemory=4000 State=UNKNOWN"
            for name, at in zip(self.names, ports)
        ]
        user = pwd.getpwuid(os.geteuid()).pw_name
        text = CONF.format(folder=self.folder, host=host, user=user, port=port, nodes="\n".join(nodes))
        (self.folder / "slurm.conf").write_text(text)
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith(("SLURM", "SBATCH"))}
        self.environment |= {"SLURM_CONF": str(self.folder / "slurm.conf"), "PATH": PATH}
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        munged = ["munged", "--foreground", "--force", f"--key-file={key}", f"--socket={self.folder}/munge.socket"]
        munged += [f"--{what}-file={self.folder}/munge.{what}" for what in ("pid", "log", "seed")]
        self.daemon("munged", munged)
        wait("munged", 10, (self.folder / "munge.socket").exists)
        self.daemon("slurmctld", ["slurmctld", "-D", "-i"])
        for name in self.names:
            self.node(name)
        states = ["sinfo", "-h", "-N", "-p", "all", "-o", "%T"]
        # The controller may not accept connections yet.
        wait("the nodes", 40, lambda: self.run(*states, check=False).stdout.split() == ["idle"] * len(self.names))

    def node(self, name):
        """Starts the daemon of a node."""
        self.daemon(name, ["slurmd", "-D", "-N", name])

    def daemon(self, name, command):
        with open(self.folder / "log" / f"{name}.out", "ab") as log:
            # In a separate session: Ctrl-C in a test leaves the daemons to __exit__.
            self.daemons[name] = subprocess.Popen(
                command, env=self.environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True
            )

    def stop(self, name, how=signal.SIGTERM):
        process = self.daemons.pop(name)
        process.send_signal(how)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def lose(self, name):
        """Kills a node: its daemon and all processes on it, without notice to the controller."""
        self.stop(name, signal.SIGKILL)
        for pid in self.of_jobs(name):
            end(pid, signal.SIGKILL)

    def processes(self):
        """Yields all processes of this Slurm: number, name, environment."""
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                variables = dict(line.partition("=")[::2] for line in read(entry / "environ").split("\0"))
                if variables.get("SLURM_CONF") == str(self.folder / "slurm.conf"):
                    yield int(entry.name), read(entry / "comm").strip(), variables
            except OSError:
                # The process has ended meanwhile.
                continue

    def of_jobs(self, node=None):
        """Returns the processes of jobs on one node or on all; first the watching processes, which would report the
        loss.
        """
        watchers, jobs = [], []
        for pid, name, variables in self.processes():
            if "SLURMD_NODENAME" in variables and node in (None, variables["SLURMD_NODENAME"]):
                jobs.append(pid)
            elif name.startswith("slurmstepd") and node in (None, self.node_of(pid)):
                watchers.append(pid)
        return watchers + jobs

    def node_of(self, watcher):
        """Returns the node of a slurmstepd, found through one of its children."""
        for pid, _, variables in self.processes():
            try:
                parent = int(read(Path(f"/proc/{pid}/stat")).rsplit(")", 1)[1].split()[1])
            except OSError:
                continue
            if parent == watcher and "SLURMD_NODENAME" in variables:
                return variables["SLURMD_NODENAME"]
        return None

    def run(self, *command, check=True, **options):
        """Runs a command with this Slurm. Returns its output."""
        done = subprocess.run(
            [str(word) for word in command], env=self.environment, capture_output=True, text=True, check=False, **options
        )
        if check and done.returncode != 0:
            raise RuntimeError(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
        return done.stdout if check else done

    def clear(self):
        """Cancels all remaining jobs and waits for their end."""
        self.run("scancel", f"--user={os.geteuid()}")
        wait("the end of all jobs", 60, lambda: not self.run("squeue", "-h"))

    def state(self, job):
        """Returns state, reason, restarts and exit code of every task of a job."""
        found = []
        for line in self.run("scontrol", "-o", "show", "job", job).splitlines():
            fields = dict(word.partition("=")[::2] for word in line.split())
            wanted = ("JobId", "ArrayTaskId", "JobState", "Reason", "Restarts", "ExitCode", "NodeList")
            found.append({key: fields.get(key, "") for key in wanted})
        return found

    def ended(self, job, seconds):
        """Waits for the end of a job with all its tasks. Returns their states."""
        over = {"COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "OUT_OF_MEMORY"}
        wait(f"job {job}", seconds, lambda: all(task["JobState"] in over for task in self.state(job)))
        return self.state(job)


def read(path):
    return path.read_bytes().decode(errors="replace")


def end(pid, how):
    try:
        os.kill(pid, how)
    except ProcessLookupError:
        pass


def wait(what, seconds, condition, every=0.2):
    """Waits until a condition holds."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            raise TimeoutError(f"{what}: not within {seconds} s")
        time.sleep(every)
