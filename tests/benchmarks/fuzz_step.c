/* A libFuzzer target for slipid_step: bytes are a sequence of steps. The first byte of each says what
   follows, in its two lowest bits:
     0  numbers of a reading, a reference and dt, as raw doubles
     1  the place of one such number and a raw double: the last step with that number replaced
     2  a byte for every wheel's speed and one for every current: the robot drives on for dt = 0.05
     3  the last step as many times more as the other six bits say, its wheels turning on
   After every step all of the estimate and the command must be numbers, and the command within the
   limit of the wheels. */
#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "slipid.h"

#define READ (sizeof(slipid_reading) / sizeof(slipid_real))
#define NUMBERS (READ + 7)
#define LIMIT 13.0
#define MOST 500 /* steps of an input */
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

typedef struct {
  double row[NUMBERS]; /* reading, reference, dt */
  double speed[SLIPID_WHEELS];
  slipid_state state;
  long count;
} run_t;

static const double BEYOND = LIMIT * 1e-6;

static void fail(const run_t *run, const char *what, double value) {
  fprintf(stderr, "step %ld: %s is %.17g; reading, reference and dt:\n", run->count, what, value);
  for (size_t k = 0; k < NUMBERS; ++k) {
    fprintf(stderr, "%.17g ", run->row[k]);
  }
  fprintf(stderr, "\n");
  abort();
}

/* All numbers of the estimate lie in front of its truth values. */
static void check(const run_t *run, const slipid_estimate *estimate, const slipid_real *command) {
  const slipid_real *said = (const slipid_real *)(const void *)estimate;
  for (size_t k = 0; k < offsetof(slipid_estimate, stale) / sizeof(slipid_real); ++k) {
    if (!isfinite(said[k])) {
      fprintf(stderr, "number %zu of the estimate\n", k);
      fail(run, "the estimate", (double)said[k]);
    }
  }
  for (int i = 0; i < SLIPID_WHEELS; ++i) {
    if (!(fabs((double)command[i]) <= LIMIT + BEYOND)) {
      fail(run, "a command", (double)command[i]);
    }
  }
}

static void step(run_t *run) {
  slipid_reading reading;
  slipid_estimate estimate;
  slipid_real given[NUMBERS], command[SLIPID_WHEELS];
  for (size_t k = 0; k < NUMBERS; ++k) {
    const double x = run->row[k];
    /* a double beyond a float is one beyond it in C too */
    given[k] = sizeof(slipid_real) == 8 || !(fabs(x) > 3e38) ? (slipid_real)x
                                                            : (slipid_real)(x > 0 ? INFINITY : -INFINITY);
  }
  memcpy(&reading, given, sizeof reading);
  slipid_step(&run->state, &reading, &given[READ], given[NUMBERS - 1], &estimate, command);
  check(run, &estimate, command);
  ++run->count;
}

static void turn(run_t *run) {
  for (int i = 0; i < SLIPID_WHEELS; ++i) {
    run->row[i] += 0.05 * run->speed[i]; /* angles are first in a reading */
  }
}

static void drive(run_t *run, const uint8_t *bytes) {
  double *current = &run->row[offsetof(slipid_reading, current) / sizeof(slipid_real)];
  for (int i = 0; i < SLIPID_WHEELS; ++i) {
    run->speed[i] = 0.1 * (double)(int8_t)bytes[i];
    current[i] = (double)(int8_t)bytes[SLIPID_WHEELS + i] / 32.0;
    if (!isfinite(run->row[i])) {
      run->row[i] = 0.0;
    }
  }
  run->row[NUMBERS - 1] = 0.05;
  turn(run);
}

/* Bytes that a step takes after the first; 0 where there are too few. */
static size_t take(run_t *run, uint8_t first, const uint8_t *bytes, size_t left) {
  const size_t needs[4] = {sizeof run->row, 9, 2 * SLIPID_WHEELS, 0};
  if (left < needs[first % 4]) {
    return left;
  }
  switch (first % 4) {
  case 0:
    memcpy(run->row, bytes, sizeof run->row);
    break;
  case 1:
    memcpy(&run->row[bytes[0] % NUMBERS], bytes + 1, sizeof(double));
    break;
  case 2:
    drive(run, bytes);
    break;
  default:
    for (int k = first / 4; k > 0; --k) {
      turn(run);
      step(run);
    }
    return 0;
  }
  step(run);
  return needs[first % 4];
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  static run_t run;
  const slipid_real pose[3] = {0, 0, 0};
  memset(&run, 0, sizeof run);
  for (size_t k = 0; k < READ; ++k) {
    run.row[k] = NAN;
  }
  run.row[NUMBERS - 1] = 0.05;
  slipid_init(&run.state, pose);
  for (size_t at = 0; at < size && run.count < MOST;) {
    const uint8_t first = data[at++];
    at += take(&run, first, data + at, size - at);
  }
  return 0;
}
