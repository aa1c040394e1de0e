/* Compares the code of this folder with reference steps of slipid: cc -O2 -Isrc -o check test/check.c src/slipid.c -lm
   Prints the largest difference; the exit code is 0 if the difference is small enough. */
#include <math.h>
#include <stdio.h>

#include "slipid.h"

#include "golden.h"

#ifdef SLIPID_FLOAT
#define TOLERANCE 1e-3 /* accumulated rounding of 32-bit numbers over all steps */
#else
#define TOLERANCE 1e-9
#endif

static double worst = 0.0;

static void compare(const char *what, int step, double got, double want, double scale) {
  const double size = fabs(want) > scale ? fabs(want) : scale;
  const double gap = got == want ? 0.0 : fabs(got - want) / size;
  if (!(gap <= TOLERANCE)) {
    printf("step %d, %s: %.17g; expected %.17g\n", step, what, got, want);
  }
  worst = gap > worst || !(gap == gap) ? gap : worst;
}

int main(void) {
  static slipid_state state;
  static slipid_estimate estimate;
  static slipid_reading reading;
  const slipid_real start[3] = {0, 0, 0};
  slipid_real command[SLIPID_DRIVES];
  double said[GOLDEN_SAID];
  slipid_init(&state, start);
  for (int step = 0; step < GOLDEN_STEPS; ++step) {
    slipid_real demand[9]; /* reference, twist */
    const slipid_real dt = (slipid_real)golden_given[step][GOLDEN_GIVEN - 1];
    golden_reading(&reading, golden_given[step]);
    for (int k = 0; k < 9; ++k) {
      demand[k] = (slipid_real)golden_given[step][GOLDEN_GIVEN - 10 + k];
    }
    if (isnan(demand[6])) {
      slipid_step(&state, &reading, demand, dt, &estimate, command);
    } else {
      slipid_drive(&state, &reading, demand + 6, dt, &estimate, command);
    }
    golden_said_of(&estimate, said);
    for (int k = 0; k < GOLDEN_SAID; ++k) {
      compare(golden_names[k], step, said[k], golden_said[step][k], golden_scale[k]);
    }
    for (int k = 0; k < SLIPID_DRIVES; ++k) {
      compare("command", step, (double)command[k], golden_command[step][k], 1.0);
    }
  }
  printf("%d steps, %d numbers each: largest difference %.1e, allowed %.0e\n", GOLDEN_STEPS,
         GOLDEN_SAID + SLIPID_DRIVES, worst, TOLERANCE);
  return worst <= TOLERANCE ? 0 : 1;
}
