#!/usr/bin/env bash
# The vcan lane: tests/vcan on real SocketCAN, natively where this kernel has it, else in a Debian kernel under virtme-ng.
#
#   tests/vcan/run.sh [PYTEST ARGUMENTS]     PYTHON=.venv/bin/python chooses the interpreter
#
# It succeeds only if pytest ran on a working vcan0 and ended with 0: no SocketCAN, no boot or no result is a failure.
set -euo pipefail

channel=vcan0
packages=(qemu-system-x86 linux-image-amd64 kmod iproute2 udev busybox-static can-utils)
boot_limit=${VCAN_LANE_SECONDS:-2100} # KVM is not used: everything in the guest takes about 20 times longer

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
    as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq update
    as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends "${missing[@]}" >/dev/null
}

run_tests() {
    say "running tests/vcan on $channel, kernel $(uname -r)"
    "$python" -m pytest tests/vcan -vv -p no:cacheprovider -o faulthandler_timeout=300 "$@"
}

# The newest kernel of this machine that brings the vcan module.
bootable_kernel() {
    local version
    for version in $(ls /lib/modules | sort -rV); do
        if [ -r "/boot/vmlinuz-$version" ] && compgen -G "/lib/modules/$version/kernel/drivers/net/can/vcan.ko*" >/dev/null; then
            echo "/boot/vmlinuz-$version"
            return
        fi
    done
}

# What the guest runs. Its exit code comes back in a file: virtme-ng has been seen to lose it.
inside() {
    local result=$1 code=0
    shift
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

stop_guest() {
    kill "$guest" 2>/dev/null # timeout passes it on to vng and QEMU
    wait "$guest" || true
}

in_guest() {
    local kernel code=0 command show reader
    install_missing "${packages[@]}"
    kernel=$(bootable_kernel)
    [ -n "$kernel" ] || fail "no kernel with vcan under /boot; type: apt-get install --reinstall linux-image-amd64"
    PATH=$(dirname "$python"):$PATH
    command -v vng >/dev/null || fail "virtme-ng is missing; type: $python -m pip install virtme-ng"

    result=$(mktemp -d) # global: the traps need it after this function, as they need guest
    trap 'rm -rf "$result"' EXIT
    # Without the compiler's library: loading it there takes longer than all loops as plain Python.
    printf -v command '%q ' env "PYTHON=$python" NUMBA_DISABLE_JIT=1 bash tests/vcan/run.sh --inside "$result" "$@"
    say "this kernel has no usable SocketCAN; booting ${kernel#/boot/} in QEMU without KVM (half a minute, then slowly)"
    # Through a pipe: vng opens its standard output anew, and a file would be written over from its start.
    exec {show}> >(exec cat)
    reader=$!
    timeout -k 10 "$boot_limit" vng --disable-kvm -r "$kernel" --cpus 2 --memory 4G --user root --rw \
        --rwdir="$result" --cwd "$PWD" -- "$command" </dev/null >&"$show" 2>&1 &
    guest=$!
    trap 'stop_guest; exit 130' INT
    trap 'stop_guest; exit 143' TERM
    wait "$guest" || code=$?
    trap - INT TERM
    exec {show}>&-
    wait "$reader"
    if [ ! -s "$result/exit-code" ]; then
        fail "the guest ended without a result (vng: exit code $code; 124 means longer than $boot_limit s)"
    fi
    code=$(cat "$result/exit-code")
    say "pytest in the guest ended with exit code $code"
    return "$code"
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
