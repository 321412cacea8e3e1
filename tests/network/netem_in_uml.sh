#!/bin/sh
# Runs test_kernel_netem.py on a kernel that has netem, where that of the machine has none: User Mode Linux, a kernel that
# is an ordinary process (Debian: apt-get install user-mode-linux iproute2). Start it as root, at the root of the
# repository: tests/network/netem_in_uml.sh [PYTHON]. It uses the machine's files; on a busy machine give it priority
# (nice -n -10), since delays are measured.
set -e
if [ $$ -ne 1 ]; then
    test -d /usr/lib/uml/modules || { echo "needs the package user-mode-linux" >&2; exit 2; }
    exec linux.uml mem=1024M rootfstype=hostfs rootflags=/ rw quiet con=null con0=fd:0,fd:1 init="$(realpath "$0")" \
        HOME=/root NETEM_PWD="$PWD" NETEM_PYTHON="${1:-.venv/bin/python}" </dev/null
fi
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export PATH
cd "$NETEM_PWD"
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t tmpfs tmp /run
ip link set lo up
"$NETEM_PYTHON" - /usr/lib/uml/modules/"$(uname -r)"/kernel/drivers/net/veth.ko \
    /usr/lib/uml/modules/"$(uname -r)"/kernel/net/sched/sch_netem.ko <<'END' || true
import ctypes, os, sys
for module in sys.argv[1:]:  # as insmod does, which need not be there
    ctypes.CDLL(None).syscall(313, os.open(module, os.O_RDONLY), b"", 0)
END
"$NETEM_PYTHON" -m pytest -n 0 -p no:cacheprovider -rA --basetemp=/run/pytest tests/network/test_kernel_netem.py || true
echo o > /proc/sysrq-trigger
sleep 5
