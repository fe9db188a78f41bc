#!/usr/bin/env bash
# Run the tests in tests/vcan on real SocketCAN: on this kernel if it has SocketCAN, otherwise in a guest kernel.
#
#   tests/vcan/run.sh [PYTEST ARGUMENTS]     PYTHON=.venv/bin/python chooses the interpreter
#   GUEST=uml|qemu tests/vcan/run.sh ...     chooses the guest: uml is User-Mode Linux (native speed, one CPU; two guests share
#                                            the tests if this machine has two CPUs), qemu is a Debian kernel in QEMU without
#                                            KVM (two CPUs, about 20 times slower)
#
# Without GUEST, uml is used if it boots here, otherwise qemu. The script succeeds only if pytest ran on a working vcan0 and
# ended with 0: no SocketCAN, no boot or no result is a failure.
set -euo pipefail

channel=vcan0
uml_packages=(user-mode-linux kmod iproute2 can-utils gcc libc6-dev)
qemu_packages=(qemu-system-x86 linux-image-amd64 kmod iproute2 udev busybox-static can-utils)
apt_wait=300 # s; another program may hold the lock of dpkg
uml_boot_limit=60
uml_limit=${VCAN_LANE_SECONDS:-1500}
qemu_limit=${VCAN_LANE_SECONDS:-2100}
memory_mb=4096
map_limit=1048576 # memory mappings of a process; Linux permits 65530 by default
uml_guests=$(($(nproc) > 1 ? 2 : 1)) # a guest has one CPU

say() { printf 'vcan lane: %s\n' "$*" >&2; }
fail() {
    say "$*"
    exit 1
}

as_root() {
    if [ "$(id -u)" = 0 ]; then
        "$@"
    elif command -v sudo >/dev/null; then
        sudo "$@"
    else
        say "this needs root and there is no sudo; type as root: $*"
        return 1
    fi
}

has_socketcan() {
    "$python" -c 'import socket; socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()' 2>/dev/null
}

vcan_is_ready() {
    local device=/sys/class/net/$channel
    [ -e "$device" ] && [ "$(cat "$device/mtu")" -ge 72 ] && [ "$(cat "$device/tx_queue_len")" -ge 1000 ] &&
        [ $(($(cat "$device/flags") & 1)) = 1 ]
}

make_vcan_ready() {
    vcan_is_ready && return
    as_root modprobe -q -a can can-raw vcan || true # built in, or already there
    [ -e /sys/class/net/$channel ] || as_root ip link add $channel type vcan || return
    as_root ip link set $channel down && as_root ip link set $channel mtu 72 txqueuelen 1000 up || return
    vcan_is_ready
}

install_missing() {
    local missing=() package
    for package in "$@"; do
        [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || missing+=("$package")
    done
    [ ${#missing[@]} = 0 ] && return
    command -v apt-get >/dev/null || fail "these Debian packages are needed and there is no apt-get: ${missing[*]}"
    say "installing ${missing[*]} (once)"
    local apt=(env DEBIAN_FRONTEND=noninteractive apt-get -qq -o "DPkg::Lock::Timeout=$apt_wait")
    if ! as_root "${apt[@]}" update ||
        ! as_root "${apt[@]}" install -y --no-install-recommends "${missing[@]}" >/dev/null; then
        fail "apt-get could not install ${missing[*]}"
    fi
}

run_tests() {
    say "running tests/vcan on $channel, kernel $(uname -r)"
    "$python" -m pytest tests/vcan -vv -n 0 -p no:cacheprovider -o faulthandler_timeout=300 "$@"
}

# Print the newest kernel of this machine that has the vcan module.
bootable_kernel() {
    local version
    for version in $(ls /lib/modules | sort -rV); do
        if [ -r "/boot/vmlinuz-$version" ] && compgen -G "/lib/modules/$version/kernel/drivers/net/can/vcan.ko*" >/dev/null; then
            echo "/boot/vmlinuz-$version"
            return
        fi
    done
}

# Run the tests inside a guest. The exit code is written to a file, because a guest cannot return an exit code.
inside() {
    local result=$1 code=0
    shift
    touch "$result/booted"
    if make_vcan_ready; then
        run_tests "$@" || code=$?
    else
        say "the guest kernel $(uname -r) could not make $channel"
        code=1
    fi
    echo "$code" >"$result/exit-code"
    sync
    return "$code"
}

stop_guests() {
    kill "${guests[@]}" 2>/dev/null # timeout passes the signal on to the processes of the guest
    wait "${guests[@]}" || true
}

# Run guests in the background until all have ended or the operator interrupts them; `guests` are their processes.
await_guests() {
    local guest code=0
    trap 'stop_guests; exit 130' INT
    trap 'stop_guests; exit 143' TERM
    for guest in "${guests[@]}"; do
        wait "$guest" || code=$?
    done
    trap - INT TERM
    return "$code"
}

# Return the exit code that pytest left in the folder of a guest; fail if there is none.
result_of_guest() {
    local folder=$1 code
    [ -s "$folder/exit-code" ] || fail "the guest ended without a result ($2; 124 means longer than its time limit)"
    code=$(cat "$folder/exit-code")
    say "pytest in the guest ended with exit code $code"
    return "$code"
}

# Print the init script of User-Mode Linux. The guest has the root folder of this machine (hostfs), and its own /run for the
# files of the tests.
uml_init() {
    # A page fault takes 0.1 ms in the guest, and each body of PyBullet needs 28 MB. Therefore malloc keeps freed memory.
    cat <<EOF
#!/bin/bash
export PATH='$PATH' HOME='$HOME' PYTHON='$python' TMPDIR=/run/tmp ATALANTE_VCAN_CLAIMS='$result/claims'
export MALLOC_MMAP_THRESHOLD_=$((1 << 30)) MALLOC_TRIM_THRESHOLD_=$((1 << 30))
mount -t proc proc /proc && mount -t sysfs sys /sys
mountpoint -q /dev || mount -t devtmpfs dev /dev
mkdir -p /dev/shm /dev/pts && mount -t devpts pts /dev/pts
mount -t tmpfs run /run && mount -t tmpfs shm /dev/shm && mkdir /run/tmp
mount --bind /usr/lib/uml/modules /lib/modules
ip link set lo up
cd '$PWD' && bash tests/vcan/run.sh --inside '$1' $2
sync
halt -f
EOF
}

# Permit more memory mappings until the end of this script. User-Mode Linux maps each page of a process of the guest separately,
# so with the default of Linux, a process of the guest is killed when it has more than 256 MB.
raise_map_limit() {
    local file=/proc/sys/vm/max_map_count
    map_limit_before=$(cat $file) # global: the trap needs it
    [ "$map_limit_before" -lt $map_limit ] || return 0
    if as_root sh -c "echo $map_limit >$file" 2>/dev/null; then
        trap 'rm -rf "$result"; as_root sh -c "echo $map_limit_before >/proc/sys/vm/max_map_count"' EXIT
    else
        say "$file is $map_limit_before and cannot be changed; a test process with more than 256 MB would be killed"
    fi
}

# Boot one User-Mode Linux in the background. $1: folder for its results. $2: arguments of pytest, quoted for the shell.
boot_uml() {
    local folder=$1 memory=/dev/shm
    mkdir -p "$folder"
    uml_init "$folder" "$2" >"$folder/init"
    chmod +x "$folder/init"
    # The memory of the guest is a file in /dev/shm, or on the disk if /dev/shm is too small.
    [ "$(df --output=avail -m $memory 2>/dev/null | tail -1 || echo 0)" -gt $((uml_guests * memory_mb + 512)) ] ||
        memory=$folder
    TMPDIR=$memory timeout -k 10 "$uml_limit" env LD_PRELOAD="$result/uml_xstate.so" \
        linux.uml mem=${memory_mb}M rootfstype=hostfs rootflags=/ rw init="$folder/init" con=null con0=fd:0,fd:1 quiet </dev/null > >(exec sed -u "s/^/$(basename "$folder"): /") \
        2>"$folder/kernel.log" &
    guests+=($!)
    { sleep $uml_boot_limit && [ ! -e "$folder/booted" ] && kill "${guests[-1]}"; } >/dev/null 2>&1 &
    watchers+=($!)
}

# Return 3 if this machine cannot boot User-Mode Linux, otherwise the first exit code of pytest that is not 0.
# The guests have one CPU each and share the tests: each guest claims its next test in `claims`.
in_uml() {
    local code=0 worst=0 arguments="" number folder guests=() watchers=()
    install_missing "${uml_packages[@]}"
    [ -d /lib/modules ] || as_root mkdir -p /lib/modules # the guest mounts its own modules there
    [ $# = 0 ] || printf -v arguments '%q ' "$@"
    raise_map_limit
    mkdir "$result/claims"
    "${CC:-cc}" -O2 -shared -fPIC -o "$result/uml_xstate.so" tests/vcan/uml_xstate.c
    say "this kernel has no usable SocketCAN; booting $uml_guests times User-Mode Linux $(linux.uml --version)"
    for number in $(seq "$uml_guests"); do
        boot_uml "$result/guest$number" "$arguments"
    done
    await_guests || code=$?
    kill "${watchers[@]}" 2>/dev/null || true
    for folder in "$result"/guest*; do
        if [ ! -e "$folder/booted" ]; then
            say "User-Mode Linux does not boot on this machine (exit code $code):"
            tail -5 "$folder/kernel.log" >&2
            return 3
        fi
    done
    for folder in "$result"/guest*; do
        (result_of_guest "$folder" "linux.uml: exit code $code") || worst=$((worst ? worst : $?))
    done
    return $worst
}

in_qemu() {
    local kernel code=0 command show reader guests
    install_missing "${qemu_packages[@]}"
    kernel=$(bootable_kernel)
    [ -n "$kernel" ] || fail "no kernel with vcan under /boot; type: apt-get install --reinstall linux-image-amd64"
    PATH=$(dirname "$python"):$PATH
    command -v vng >/dev/null || fail "virtme-ng is missing; type: $python -m pip install virtme-ng"
    # Without compilation, because loading the library of the compiler takes longer in QEMU than all loops as plain Python.
    printf -v command '%q ' env "PYTHON=$python" NUMBA_DISABLE_JIT=1 ATALANTE_VCAN_PATIENCE=180 \
        bash tests/vcan/run.sh --inside "$result" "$@"
    say "this kernel has no usable SocketCAN; booting ${kernel#/boot/} in QEMU without KVM (half a minute, then slowly)"
    # The output goes through a pipe, because vng opens its standard output again and would overwrite a file from its start.
    exec {show}> >(exec cat)
    reader=$!
    timeout -k 10 "$qemu_limit" vng --disable-kvm -r "$kernel" --cpus 2 --memory ${memory_mb}M --user root --rw \
        --rwdir="$result" --cwd "$PWD" -- "$command" </dev/null >&"$show" 2>&1 &
    guests=($!)
    await_guests || code=$?
    exec {show}>&-
    wait "$reader"
    result_of_guest "$result" "vng: exit code $code"
}

in_guest() {
    local code=0
    mkdir -p .lane
    result=$(mktemp -d "$PWD/.lane/XXXXXX") # global: the traps need it after this function
    trap 'rm -rf "$result"' EXIT
    case ${GUEST:-} in
        uml) in_uml "$@" ;;
        qemu) in_qemu "$@" ;;
        "")
            in_uml "$@" || code=$?
            [ $code = 3 ] || return $code
            in_qemu "$@"
            ;;
        *) fail "GUEST must be uml or qemu, got ${GUEST}" ;;
    esac
}

main() {
    cd "$(dirname "${BASH_SOURCE[0]}")/../.."
    python=${PYTHON:-.venv/bin/python}
    [ -n "${PYTHON:-}" ] || [ -x "$python" ] || python=$(command -v python3)
    python=$(cd "$(dirname "$(command -v "$python")")" && pwd)/$(basename "$python") # not resolved: a venv is its path
    [ -x "$python" ] || fail "there is no Python at ${PYTHON:-.venv/bin/python}; type: python3 -m venv .venv and" \
        ".venv/bin/pip install -e '.[dev]'"

    if [ "${1:-}" = --inside ]; then
        shift
        inside "$@"
    elif has_socketcan && make_vcan_ready; then
        command -v candump >/dev/null || install_missing can-utils
        run_tests "$@"
    else
        in_guest "$@"
    fi
}

main "$@"
exit
