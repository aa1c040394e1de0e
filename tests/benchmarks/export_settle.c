/* Time of the contact balance of one robot on all its combinations of floors, by the generated code
   and by its twin in turns [ns a step], and the largest difference of their twists. The file has
   counts of steps and combinations, rim speeds (step, wheel), and a Floor of twin.c for each
   combination. */
#define _POSIX_C_SOURCE 199309L
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include TWIN

#define PASSES 41
void settled(const double start[3 * COMBINATIONS], const double rim[3],
             double twist[3 * COMBINATIONS], double felt[W * COMBINATIONS]);
static double took[2][PASSES], mine[2][3 * COMBINATIONS], traction[W * COMBINATIONS];
static double theirs[COMBINATIONS][3], apart;

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

static void begin(void) {
  for (int k = 0; k < 3 * COMBINATIONS; ++k) {
    mine[0][k] = 0;
    theirs[k / 3][k % 3] = 0;
  }
}

static void by_twin(const double *rim, const Floor *floors) {
  double felt[W];
  for (int k = 0; k < COMBINATIONS; ++k) {
    settle(theirs[k], rim, &floors[k], CHORDS, NEWTONS, felt);
    traction[k] += felt[0];
  }
}

static void compare(int at) {
  for (int k = 0; k < 3 * COMBINATIONS; ++k) {
    const double gap = fabs(mine[at][k] - theirs[k % COMBINATIONS][k / COMBINATIONS]);
    apart = gap <= apart ? apart : gap;
  }
}

static int by_size(const void *a, const void *b) {
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

int main(int argc, char **argv) {
  FILE *file = argc > 1 ? fopen(argv[1], "rb") : NULL;
  int64_t counts[2];
  if (!file || fread(counts, sizeof counts, 1, file) != 1 || counts[1] != COMBINATIONS) {
    return 1;
  }
  const int64_t steps = counts[0];
  double *rims = malloc(sizeof(double) * W * (size_t)steps);
  Floor *floors = malloc(sizeof(Floor) * COMBINATIONS);
  if (fread(rims, sizeof(double) * W, (size_t)steps, file) != (size_t)steps ||
      fread(floors, sizeof(Floor), COMBINATIONS, file) != COMBINATIONS) {
    return 2;
  }
  begin();
  for (int64_t n = 0; n < steps; ++n) { /* side by side, from common starts */
    settled(mine[n % 2], &rims[W * n], mine[(n + 1) % 2], traction);
    by_twin(&rims[W * n], floors);
    compare((int)((n + 1) % 2));
    for (int k = 0; k < 3 * COMBINATIONS; ++k) {
      mine[(n + 1) % 2][k] = theirs[k % COMBINATIONS][k / COMBINATIONS];
    }
  }
  for (int pass = 0; pass < PASSES; ++pass) {
    begin();
    double began = now();
    for (int64_t n = 0; n < steps; ++n) {
      settled(mine[n % 2], &rims[W * n], mine[(n + 1) % 2], traction);
    }
    took[0][pass] = (now() - began) / (double)steps;
    began = now();
    for (int64_t n = 0; n < steps; ++n) {
      by_twin(&rims[W * n], floors);
    }
    took[1][pass] = (now() - began) / (double)steps;
  }
  for (int way = 0; way < 2; ++way) {
    qsort(took[way], PASSES, sizeof(double), by_size);
  }
  printf("%.1f %.1f %.3e %g\n", took[0][PASSES / 2], took[1][PASSES / 2], apart, traction[0]);
  return 0;
}
