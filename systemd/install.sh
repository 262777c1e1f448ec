#!/usr/bin/env bash
# Install or upgrade the service on Debian or Ubuntu: `sudo make install`.
#
#   systemd/install.sh [software | wheels]
#
# The software goes to /opt/vdms-rt, in a folder of its own for each version: what runs meanwhile goes
# on undisturbed, and an installation that fails changes nothing. Then come user, udev rules, service,
# and /etc/vdms-rt/vdms-rt.toml if it is not there. `software` does the first alone, without systemd.
# `wheels`, on a computer with internet, fills a folder with what one without it needs.
#
# From the environment (`make install` hands them on):
#   WHEELS=DIR     that folder
#   PYTHON=FILE    the Python to run it with, 3.11 or newer (/usr/bin/python3)
set -euo pipefail
cd "$(dirname "$0")/.."
# Also for a person whose own files nobody else may read.
umask 022

home=/opt/vdms-rt
config=/etc/vdms-rt/vdms-rt.toml
local=/usr/local/lib
python=${PYTHON:-/usr/bin/python3}
wheels=${WHEELS:-}

say() { echo "vdms-rt: $*"; }
die() {
    say "$*" >&2
    exit 1
}

check_root() {
    [ "$(id -u)" = 0 ] || die "only root can install it; use: sudo make install"
}

check_systemd() {
    [ -d /run/systemd/system ] ||
        die "systemd does not run on this computer, and the service needs it"
}

check_wheels() {
    [ -z "$wheels" ] || [ -d "$wheels" ] ||
        die "WHEELS=$wheels is not a folder; fill one with \`make wheels\` on a computer with internet"
}

check_python() {
    # Under /home or /root the service's user could not reach it.
    case $(realpath "$(command -v "$python" || echo /nowhere)") in
    /nowhere) die "there is no $python; install it with: apt install python3 python3-venv" ;;
    /home/* | /root/*) die "$python lies in somebody's home, where the service cannot reach it; name another with: sudo make install PYTHON=/usr/bin/python3" ;;
    esac
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        die "$python is $("$python" -V), and 3.11 or newer is needed; name one with: sudo make install PYTHON=/usr/bin/python3.12"
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
        die "$python cannot make virtual environments; install what it needs with: apt install python3-venv"
}

fetch_wheels() {
    local scratch
    scratch=$(mktemp -d)
    trap 'rm -rf "$scratch"' EXIT
    "$python" -m venv "$scratch"
    "$scratch/bin/python" -m pip download --quiet --disable-pip-version-check \
        --require-hashes -r requirements/run.txt --dest "$wheels"
    rm -rf "$scratch"
    trap - EXIT
    say "$wheels holds what to install from, on a computer like this one, with: sudo make install WHEELS=$wheels"
}

# What tells one version of the software from another: all that goes into it.
fingerprint() {
    {
        "$python" -VV
        find src -type f -not -path '*/__pycache__/*' -print0 | sort -z | xargs -0 sha256sum
        sha256sum pyproject.toml README.md requirements/run.txt
    } | sha256sum | cut -c1-12
}

install_software() {
    local version from=()
    version=$(fingerprint)
    if [ ! -e "$home/$version/complete" ]; then
        say "installing the software into $home/$version"
        [ -z "$wheels" ] || from=(--no-index --find-links "$wheels")
        rm -rf "${home:?}/$version"
        mkdir -p "$home"
        trap 'rm -rf "${home:?}/$version"' EXIT
        "$python" -m venv "$home/$version"
        pip "$version" "${from[@]}" --require-hashes -r requirements/run.txt
        # What builds it is in run.txt too.
        pip "$version" --no-index --no-deps --no-build-isolation .
        touch "$home/$version/complete"
        trap - EXIT
    fi
    ln -sfn "$version" "$home/.next"
    mv -T "$home/.next" "$home/current"
}

pip() {
    local version=$1
    shift
    "$home/$version/bin/python" -m pip install --quiet --disable-pip-version-check "$@"
}

remove_other_versions() {
    find "$home" -mindepth 1 -maxdepth 1 -type d -not -name "$(readlink "$home/current")" -exec rm -rf {} +
}

install_service() {
    install -D -m 644 systemd/vdms-rt.sysusers "$local/sysusers.d/vdms-rt.conf"
    systemd-sysusers "$local/sysusers.d/vdms-rt.conf"
    install -D -m 644 systemd/vdms-rt.service "$local/systemd/system/vdms-rt.service"
    # A station more for each /etc/vdms-rt/NAME.toml: vdms-rt@NAME, with a set-up of its own.
    sed 's|/vdms-rt\.toml|/%i.toml|; s|^StateDirectory=.*|&/%i|' systemd/vdms-rt.service \
        >"$local/systemd/system/vdms-rt@.service"
    install -D -m 644 systemd/70-vdms-rt.rules "$local/udev/rules.d/70-vdms-rt.rules"
    mkdir -p /usr/local/bin
    ln -sfn "$home/current/bin/vdms-rt" /usr/local/bin/vdms-rt
    if [ -e "$config" ]; then
        say "$config stays as it is"
        "$home/current/bin/vdms-rt" check-config "$config" || true
    else
        install -D -m 644 config/vdms-rt.toml "$config"
    fi
    systemctl daemon-reload
    udevadm control --reload
    # A grabber that is plugged in already gets its name, and starts the service.
    udevadm trigger --action=change --subsystem-match=usb --subsystem-match=video4linux
    udevadm settle
}

start_service() {
    systemctl try-restart 'vdms-rt@*'
    if [ -e /dev/vdms-grabber ] || systemctl --quiet is-active vdms-rt; then
        if systemctl restart vdms-rt; then
            say "the service runs; look at it with: vdms-rt watch"
        else
            say "the service did not start; see why with: sudo journalctl -u vdms-rt -n 20" >&2
            exit 1
        fi
    else
        say "installed. Plug in the grabber: the service starts by itself. Then look at it with: vdms-rt watch"
    fi
}

case ${1:-} in
'')
    check_root
    check_systemd
    check_wheels
    check_python
    install_software
    install_service
    start_service
    remove_other_versions
    ;;
software)
    check_root
    check_wheels
    check_python
    install_software
    ;;
wheels)
    check_python
    fetch_wheels
    ;;
*) die "unknown: $1; see the head of $0" ;;
esac
