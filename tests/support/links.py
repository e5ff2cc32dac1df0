"""A switch between network namespaces whose links delay, reorder, lose and block packets.

Whole Ethernet frames pass through user space, so TCP on both sides behaves as on a bad network. The
script replaces the kernel's netem, which not every kernel has.

    links.py SEED NAME...    one TAP device for each link; prints "ready", then reads commands from
                             standard input until its end:
    set LINK LOSS DELAY JITTER    share of lost packets, delay and maximum deviation from it (s), in
                                  both directions
    cut LINK, heal LINK           blocks all packets; lets all packets pass again
"""

import fcntl
import heapq
import os
import random
import select
import struct
import sys
import time

TUNSETIFF = 0x400454CA
TAP_WITHOUT_HEADER = 0x1002
LARGEST_FRAME = 65536


def tap(name):
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", name.encode(), TAP_WITHOUT_HEADER))
    return device


class Link:
    def __init__(self, device):
        self.device = device
        self.loss, self.delay, self.jitter, self.is_cut = 0.0, 0.0, 0.0, False

    def delay_of_packet(self, chance):
        """Returns the delay of a packet on this link (s), or None if it is lost."""
        if self.is_cut or chance.random() < self.loss:
            return None
        return max(0.0, self.delay + self.jitter * (2 * chance.random() - 1))


def obey(links, line):
    what, link, *numbers = line.split()
    link = links[int(link)]
    if what == "set":
        link.loss, link.delay, link.jitter = map(float, numbers)
    else:
        link.is_cut = what == "cut"


def receivers(links, places, frame, source):
    """Returns the link on which the receiver of a frame has been seen, or all other links."""
    place = places.get(frame[:6])
    return [place] if place is not None else [link for link in links if link is not source]


def main():
    chance = random.Random(int(sys.argv[1]))
    links = [Link(tap(name)) for name in sys.argv[2:]]
    by_device = {link.device: link for link in links}
    places, on_the_way, number, commands = {}, [], 0, b""
    print("ready", flush=True)
    while True:
        wait = max(0.0, on_the_way[0][0] - time.monotonic()) if on_the_way else None
        readable, _, _ = select.select([0, *by_device], [], [], wait)
        for device in readable:
            if device == 0:
                said = os.read(0, 4096)
                if not said:
                    return
                *lines, commands = (commands + said).split(b"\n")
                for line in lines:
                    obey(links, line.decode())
                continue
            try:
                frame = os.read(device, LARGEST_FRAME)
            except OSError:  # not up yet
                time.sleep(0.001)
                continue
            source = by_device[device]
            places[frame[6:12]] = source
            for target in receivers(links, places, frame, source):
                delays = [link.delay_of_packet(chance) for link in (source, target)]
                if None not in delays:
                    number += 1
                    heapq.heappush(on_the_way, (time.monotonic() + sum(delays), number, target, frame))
        while on_the_way and on_the_way[0][0] <= time.monotonic():
            _, _, target, frame = heapq.heappop(on_the_way)
            try:
                os.write(target.device, frame)
            except OSError:  # down, or full: lost
                pass


main()
