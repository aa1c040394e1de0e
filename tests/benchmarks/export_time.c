/* Time of one step of the generated code, over a drive that is repeated from its start: median and
   shortest of the passes' mean processor times in ns, size of the state, count of passes. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "slipid.h"

#define MOST 20000

static slipid_state state;
static slipid_estimate estimate;
static slipid_reading *reading;
static slipid_real *reference, *passed, command[SLIPID_DRIVES];
static double took[MOST];

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

static double pass(long count) {
  const slipid_real pose[3] = {0, 0, 0};
  slipid_init(&state, pose);
  const double began = now();
  for (long k = 0; k < count; ++k) {
    slipid_step(&state, &reading[k], &reference[6 * k], passed[k], &estimate, command);
  }
  return (now() - began) / (double)count;
}

static int by_size(const void *a, const void *b) {
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static void *rows(FILE *file, long count, size_t size) {
  void *out = calloc((size_t)count, size);
  if (!out || fread(out, size, (size_t)count, file) != (size_t)count) {
    exit(2);
  }
  return out;
}

int main(int argc, char **argv) {
  FILE *file = argc > 2 ? fopen(argv[1], "rb") : NULL;
  const double seconds = argc > 2 ? atof(argv[2]) : 0;
  int64_t count;
  if (!file || fread(&count, sizeof count, 1, file) != 1) {
    return 1;
  }
  reading = rows(file, count, sizeof *reading);
  reference = rows(file, 6 * count, sizeof *reference);
  passed = rows(file, count, sizeof *passed);
  pass(count); /* warms up */
  int passes = 0;
  for (const double end = now() + 1e9 * seconds; passes < MOST && (now() < end || passes < 9);) {
    took[passes++] = pass(count);
  }
  qsort(took, (size_t)passes, sizeof(double), by_size);
  printf("%.2f %.2f %zu %d\n", took[passes / 2], took[0], sizeof state, passes);
  return 0;
}
