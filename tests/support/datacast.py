"""Sends the record of an acceleration (m/s2) as the datacast of a Raspberry Shake 4D, again and again.

Four channels at 100 Hz, 25 samples per packet. Only ENE contains the record.
"""

import socket
import sys
import time

with open(sys.argv[1]) as record:
    rows = [line.split(",") for line in record][1:]
counts = [round(float(row[1]) * 384_500) for row in rows]
receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.connect(("127.0.0.1", 8888))
start = time.time()
number = 0
while True:
    time.sleep(max(0.0, start + (number + 1) * 0.25 - time.time()))
    for channel in ["EHZ", "ENE", "ENN", "ENZ"]:
        samples = [counts[(25 * number + index) % len(counts)] for index in range(25)]
        if channel != "ENE":
            samples = [0] * 25
        numbers = ", ".join(map(str, samples))
        packet = f"{{'{channel}', {start + number * 0.25:.3f}, {numbers}}}"
        try:
            receiver.send(packet.encode())
        except ConnectionRefusedError:
            pass  # nobody listens at the moment
    number += 1
