#!/usr/bin/env bash
# Run a command in a virtual machine that boots Debian's own kernel, with its video and USB
# drivers, over this machine's root file system (read-only, a tmpfs above it).
#
#   vm.sh [-s] [-t SECONDS] [-o DIR] [--] COMMAND [ARG...]
#   vm.sh -p
#     -p           prepare this machine, and run nothing: packages and kernel
#     -s           boot systemd, with udev and the journal; else nothing runs but the command
#     -t SECONDS   limit for the whole run (600)
#     -d IMAGE     a disk, /dev/vda in the guest, which keeps what reached it when the guest is reset
#     -o DIR       host folder, writable in the guest as /mnt/out; console.log goes there too
#
# The command runs as root in the caller's working directory and with the caller's PATH. What it
# prints comes out of this script as it is written; this script exits with its status, 124 when
# it ran past the limit, 125 when the guest died. What the guest writes outside /mnt/out is lost.
#
# Needs root on Debian or Ubuntu, amd64: what is missing is installed by apt, and the kernel is
# unpacked into VDMS_RIG_CACHE (/var/cache/vdms-rig). VDMS_RIG_ACCEL=kvm uses a KVM that can run
# Debian's kernel; software emulation, the default, runs everywhere.
set -euo pipefail

cache=${VDMS_RIG_CACHE:-/var/cache/vdms-rig}
accel=${VDMS_RIG_ACCEL:-tcg,thread=multi}
limit_s=600
out=
disk=
init=command
only_prepare=
while [ $# -gt 0 ]; do
    case $1 in
        -p) only_prepare=yes; shift ;;
        -s) init=systemd; shift ;;
        -t) limit_s=$2; shift 2 ;;
        -d) disk=$2; shift 2 ;;
        -o) out=$2; shift 2 ;;
        --) shift; break ;;
        -*) echo "rig: unknown option $1" >&2; exit 2 ;;
        *) break ;;
    esac
done
say() { echo "rig: $*" >&2; }
die() { say "$*"; exit 1; }
[ $# -gt 0 ] || [ -n "$only_prepare" ] || die "no command was given to run in the virtual machine"

# --- What it needs: packages, and the kernel ------------------------------------------------
quietly() {
    local log=$cache/prepare.log
    "$@" >"$log" 2>&1 || { tail -n 20 "$log" >&2; die "failed: $*"; }
}

prepare() {
    local missing=() package image
    for package in qemu-system-x86 kmod cpio busybox-static v4l-utils usbip udev \
        systemd-sysv make python3-venv e2fsprogs; do
        dpkg-query -Wf '${db:Status-Status}' "$package" 2>/dev/null | grep -qx installed ||
            missing+=("$package")
    done
    [ ${#missing[@]} -eq 0 ] && [ -s "$cache/version" ] && return
    command -v apt-get >/dev/null || die "needs Debian or Ubuntu, for their packages and kernel"
    [ "$(dpkg --print-architecture)" = amd64 ] || die "needs an amd64 machine"
    export DEBIAN_FRONTEND=noninteractive
    quietly apt-get -q update
    if [ ${#missing[@]} -gt 0 ]; then
        say "installing ${missing[*]}"
        quietly apt-get -qy install --no-install-recommends "${missing[@]}"
    fi
    [ -s "$cache/version" ] && return
    # Unpacked, not installed: no boot loader, no initramfs hooks, nothing in /boot. Not the
    # "cloud" flavour, which has no media, USB or 9p modules.
    image=$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: \(linux-image-[0-9].*\)/\1/p' | head -1)
    [ -n "$image" ] || die "apt knows no linux-image-amd64"
    say "fetching $image"
    rm -rf "$cache/root" "$cache/deb"
    mkdir -p "$cache/deb"
    quietly env -C "$cache/deb" apt-get -q -o APT::Sandbox::User=root download "$image"
    quietly dpkg -x "$cache"/deb/*.deb "$cache/root"
    quietly depmod -b "$cache/root" "${image#linux-image-}"
    rm -rf "$cache/deb"
    echo "${image#linux-image-}" >"$cache/version"
}

[ "$(id -u)" = 0 ] || die "needs root, to install packages and to boot over this root file system"
mkdir -p "$cache"
exec 9>"$cache/lock"
flock 9
prepare
exec 9>&-
[ -z "$only_prepare" ] || exit 0
version=$(cat "$cache/version")

# --- The initramfs: busybox, the modules that mount the root, and an init --------------------
work=$(mktemp -d)
qemu_pid=
cat_pid=
clean_up() {
    [ -z "$qemu_pid" ] || kill -9 "$qemu_pid" 2>/dev/null || true
    [ -z "$cat_pid" ] || kill "$cat_pid" 2>/dev/null || true
    rm -rf "$work"
}
trap clean_up EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP
out=${out:-$work/out}
mkdir -p "$out"
out=$(realpath "$out")

initrd=$work/initrd
mkdir -p "$initrd"/{bin,modules,host,upper,root,proc,sys,dev}
cp "$(command -v busybox)" "$initrd/bin/busybox"
for module in virtio_pci 9pnet_virtio 9p overlay virtio_console virtio_rng; do
    modprobe -d "$cache/root" -S "$version" --show-depends "$module" | awk '$1 == "insmod" { print $2 }'
done | awk '!seen[$0]++' | while read -r file; do
    cp "$file" "$initrd/modules/"
    basename "$file" >>"$initrd/modules/order"
done
cat >"$initrd/init" <<'INIT'
#!/bin/busybox sh
b=/bin/busybox
$b mount -t proc proc /proc
$b mount -t sysfs sys /sys
$b mount -t devtmpfs dev /dev
while read -r module; do $b insmod "/modules/$module"; done </modules/order
options=trans=virtio,version=9p2000.L,msize=524288
$b mount -t 9p -o ro,$options,cache=loose host /host
$b mount -t tmpfs -o mode=755 tmpfs /upper
$b mkdir /upper/data /upper/work
$b mount -t overlay -o lowerdir=/host,upperdir=/upper/data,workdir=/upper/work overlay /root
$b mkdir -p /root/mnt/out /root/usr/lib/modules
# Without a cache, for both sides to see each other's files at once.
$b mount -t 9p -o rw,$options,cache=none out /root/mnt/out
for word in $($b cat /proc/cmdline); do
    case $word in
        rig.modules=*) modules=${word#rig.modules=} ;;
        rig.init=*) init=${word#rig.init=} ;;
    esac
done
$b mount -t tmpfs tmpfs /root/usr/lib/modules
$b ln -s "$modules" /root/usr/lib/modules/
$b rm -rf /root/run
$b mkdir /root/run
$b mount -t tmpfs -o mode=755 tmpfs /root/run
for directory in proc sys dev; do $b mount -o move /$directory /root/$directory; done
if [ "$init" = systemd ]; then
    # With this file there it takes the guest for a container, and does not read its command line.
    $b rm -f /root/.dockerenv
    # Of this machine's own services nothing is started, and its /tmp is left alone.
    units=/root/etc/systemd/system
    $b rm -rf $units/*.wants
    for unit in apt-daily apt-daily-upgrade dpkg-db-backup e2scrub_all fstrim man-db; do
        $b ln -sf /dev/null $units/$unit.timer
    done
    for unit in systemd-firstboot systemd-pstore systemd-networkd-wait-online; do
        $b ln -sf /dev/null $units/$unit.service
    done
    : >/root/etc/fstab
    $b ln -sf /dev/null /root/etc/tmpfiles.d/tmp.conf
    [ -s /root/etc/machine-id ] || echo 0123456789abcdef0123456789abcdef >/root/etc/machine-id
    {
        echo '[Unit]'
        echo 'Requires=basic.target rig.service'
        echo 'After=basic.target'
        echo 'AllowIsolate=yes'
    } >$units/rig.target
    {
        echo '[Unit]'
        echo 'Wants=basic.target'
        echo 'After=basic.target'
        echo '[Service]'
        echo 'ExecStart=/bin/bash /mnt/out/guest.sh'
    } >$units/rig.service
    exec $b switch_root /root /lib/systemd/systemd
fi
$b mkdir -p /root/dev/pts /root/dev/shm
$b mount -t devpts devpts /root/dev/pts
$b mount -t tmpfs tmpfs /root/dev/shm
exec $b switch_root /root /bin/bash /mnt/out/guest.sh
INIT
chmod 755 "$initrd/init"
(cd "$initrd" && find . | cpio -o -H newc --quiet | gzip -1) >"$work/initrd.gz"

# --- What the guest runs -----------------------------------------------------------------------
# Its output has a port of its own, so that kernel messages do not mix with it.
{
    echo 'exec >"/dev/$(basename /sys/class/virtio-ports/vport*)" 2>&1 </dev/null'
    printf 'export PATH=%q HOME=/root LANG=C.UTF-8 PYTHONDONTWRITEBYTECODE=1\n' "$PATH"
    echo 'ip link set lo up'
    printf 'cd %q\n' "$PWD"
    printf '(%s)\n' "$(printf '%q ' "$@")"
    echo 'echo $? >/mnt/out/status'
    # Off at once: there is nothing to save.
    echo 'sleep 0.2; exec >/dev/null 2>&1; echo o >/proc/sysrq-trigger; sleep 30'
} >"$out/guest.sh"
rm -f "$out/status"

# --- Boot ----------------------------------------------------------------------------------------
# The emulator does "rep movsb" byte by byte: without erms and fsrm, and with rep_good (112) cleared,
# the kernel copies 2 to 4 times faster, and USB video keeps up. A reliable TSC keeps reading the
# clock in user space.
cpu=host
kernel_options=
case $accel in tcg*)
    cpu=max,-erms,-fsrm
    kernel_options="clearcpuid=112 tsc=reliable clocksource=tsc"
    ;;
esac
# What the emulator took is safe from a reset, so it need not wait for this machine's disk.
disk_options=()
[ -z "$disk" ] || disk_options=(-drive "file=$disk,if=none,id=disk,format=raw,cache=unsafe"
    -device virtio-blk-pci,drive=disk)
mkfifo "$work/output"
cat "$work/output" &
cat_pid=$!
qemu-system-x86_64 -accel "$accel" -cpu "$cpu" -M q35,sata=off,smbus=off,vmport=off -smp 2 -m 2G \
    -nodefaults -no-reboot -display none \
    -chardev file,id=console,path="$out/console.log" -serial chardev:console \
    -device virtio-serial-pci -chardev file,id=output,path="$work/output" \
    -device virtserialport,chardev=output,name=rig.output -device virtio-rng-pci \
    -fsdev local,id=host,path=/,security_model=none,readonly=on,multidevs=remap \
    -device virtio-9p-pci,fsdev=host,mount_tag=host \
    -fsdev local,id=out,path="$out",security_model=none,multidevs=remap \
    -device virtio-9p-pci,fsdev=out,mount_tag=out "${disk_options[@]}" \
    -kernel "$cache/root/boot/vmlinuz-$version" -initrd "$work/initrd.gz" \
    -append "console=ttyS0 quiet loglevel=4 panic=-1 mitigations=off $kernel_options rig.modules=$cache/root/lib/modules/$version rig.init=$init systemd.unit=rig.target systemd.show_status=0" \
    </dev/null 2>"$out/qemu.log" &
qemu_pid=$!
end=$((SECONDS + limit_s))
while kill -0 "$qemu_pid" 2>/dev/null; do
    if [ $SECONDS -ge $end ]; then
        say "the guest ran past $limit_s s; its console is in $out/console.log"
        exit 124
    fi
    sleep 0.2
done
wait "$qemu_pid" || true
qemu_pid=
wait "$cat_pid" || true
cat_pid=
[ -s "$out/status" ] && exit "$(cat "$out/status")"
say "the guest died"
tail -n 20 "$out/console.log" >&2
cat "$out/qemu.log" >&2
exit 125
