# shellcheck shell=bash
# Installs and starts what the tests run on, on this machine alone: GNU parallel, a one-node Slurm, PostgreSQL; OSMesa.
# To be sourced: exports SLURM_CONF and REFINEPPO_TEST_POSTGRES; `stop_engines` ends and removes everything.
# Needs Debian or Ubuntu and root; everything listens on 127.0.0.1.

engines=$(mktemp -d)
chmod 755 "$engines"

stop_engines() {
    scancel --user=root || true
    for _ in $(seq 20); do
        if [ -z "$(squeue --noheader)" ]; then break; fi
        sleep 1
    done
    for name in slurmd slurmctld munged; do
        if [ -f "$engines/$name.pid" ]; then kill "$(cat "$engines/$name.pid")" || true; fi
    done
    as_postgres pg_ctl stop -D "$engines/postgres" -m immediate >/dev/null || true
    rm -rf "$engines"
}

as_postgres() {
    runuser -u postgres -- env PATH="$PATH:$(echo /usr/lib/postgresql/*/bin)" "$@"
}

missing=
for package in parallel slurm-wlm munge postgresql libosmesa6; do
    dpkg -s "$package" >/dev/null 2>&1 || missing+=" $package"
done
if [ -n "$missing" ]; then
    apt-get update -qq
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $missing >/dev/null
fi

# munge: a key and a socket of our own
install -d -o munge -g munge -m 755 "$engines/munge"
dd if=/dev/urandom of="$engines/munge/key" bs=1024 count=1 status=none
chown munge: "$engines/munge/key"
chmod 400 "$engines/munge/key"
runuser -u munge -- munged --key-file="$engines/munge/key" --socket="$engines/munge/socket" \
    --pid-file="$engines/munge/munged.pid" --log-file="$engines/munge/log" --seed-file="$engines/munge/seed"
ln -s munge/munged.pid "$engines/munged.pid"

# Slurm: jobs in the partition `high` send those in `low` back to the queue
export SLURM_CONF=$engines/slurm.conf
cat >"$SLURM_CONF" <<END
ClusterName=tests
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
SlurmUser=root
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthInfo=socket=$engines/munge/socket,cred_expire=2
CredType=cred/munge
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SlurmdParameters=config_overrides
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
SchedulerParameters=sched_interval=2,bf_interval=2
KillWait=10
MinJobAge=300
ReturnToService=2
StateSaveLocation=$engines/state
SlurmdSpoolDir=$engines/spool
SlurmctldPidFile=$engines/slurmctld.pid
SlurmdPidFile=$engines/slurmd.pid
SlurmctldLogFile=$engines/slurmctld.log
SlurmdLogFile=$engines/slurmd.log
NodeName=$(hostname -s) NodeAddr=127.0.0.1 CPUs=4 RealMemory=8000 State=UNKNOWN
PartitionName=low Nodes=ALL Default=YES PriorityTier=1 MaxTime=INFINITE
PartitionName=high Nodes=ALL PriorityTier=2 MaxTime=INFINITE
END
mkdir "$engines/state" "$engines/spool"
slurmctld
slurmd

# PostgreSQL: one database, reached over TCP
install -d -o postgres -g postgres -m 700 "$engines/postgres"
as_postgres initdb -D "$engines/postgres" --auth=trust >/dev/null
as_postgres pg_ctl start -w -D "$engines/postgres" -l "$engines/postgres/log" \
    -o "-p 15432 -c listen_addresses=127.0.0.1 -c unix_socket_directories=$engines/postgres" >/dev/null
export REFINEPPO_TEST_POSTGRES=postgresql+psycopg://postgres@127.0.0.1:15432/postgres
