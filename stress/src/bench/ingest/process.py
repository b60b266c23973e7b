"""CPU seconds a recording of the reference pipeline: process.py FOLDER FILE SAMPLES REPEATS.

FILE has, as f32: the temperature, the microphone's samples, the loopback's samples, and so on.
"""
import sys
import time

import numpy as np

folder, file, samples, repeats = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
sys.path.insert(0, folder)
import pipeline

rows = np.fromfile(file, "<f4").reshape(-1, 1 + 2 * samples).astype(np.float64)
foam = np.zeros(pipeline.IR_LEN)
flat = pipeline.process(rows[0, 1:1 + samples], rows[0, 1 + samples:], rows[0, 0], foam, np.ones(pipeline.IR_LEN))[0]
best = np.inf
for _ in range(repeats):
    begun = time.process_time()
    for row in rows:
        pipeline.process(row[1:1 + samples], row[1 + samples:], row[0], foam, flat)
    best = min(best, time.process_time() - begun)
print(best / len(rows))
