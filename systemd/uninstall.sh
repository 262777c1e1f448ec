#!/usr/bin/env bash
# Remove what systemd/install.sh installed: `sudo make uninstall`. Recordings, set-up, configuration
# and their owner, the user vdms-rt, stay.
set -euo pipefail

[ "$(id -u)" = 0 ] || {
    echo "vdms-rt: only root can remove it; use: sudo make uninstall" >&2
    exit 1
}
local=/usr/local/lib
systemctl stop vdms-rt 'vdms-rt@*' 2>/dev/null || true
systemctl --quiet disable vdms-rt vdms-rt@ 2>/dev/null || true
rm -f "$local"/systemd/system/vdms-rt{,@}.service "$local/udev/rules.d/70-vdms-rt.rules" \
    "$local/sysusers.d/vdms-rt.conf" /usr/local/bin/vdms-rt
# It may be a disk of its own, which stays.
[ ! -d /opt/vdms-rt ] || find /opt/vdms-rt -mindepth 1 -delete
rmdir /opt/vdms-rt 2>/dev/null || true
systemctl daemon-reload
systemctl reset-failed vdms-rt 'vdms-rt@*' 2>/dev/null || true
udevadm control --reload
for kept in /etc/vdms-rt /var/lib/vdms-rt /var/log/vdms-rt; do
    [ ! -e "$kept" ] || echo "vdms-rt: $kept stays"
done
echo "vdms-rt: removed. To remove what stays too: sudo rm -r FOLDER, and sudo userdel vdms-rt"
