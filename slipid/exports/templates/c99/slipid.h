@HEAD@
#ifndef SLIPID_H
#define SLIPID_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Compile everything with SLIPID_FLOAT for numbers of 32 bits. */
#ifdef SLIPID_FLOAT
typedef float slipid_real;
/* Names of their own, so that parts compiled for float and for double cannot be linked together. */
@SINGLE@
#else
typedef double slipid_real;
#endif

/* Hash of the robot's numbers, as robot.json has it. */
#define SLIPID_ROBOT "@ROBOT@"
@DEFINES@

@ABOUT@

@STRUCTS@
/* All that a robot keeps from step to step. */
typedef struct {
  slipid_estimator estimator;
  slipid_controller controller;
  slipid_real time; /* own time of a path that is followed [s] */
} slipid_state;

/* Start at a pose: x, y [m], heading [rad]. */
void slipid_init(slipid_state *state, const slipid_real pose[3]);

/* One control period, dt after the last one [s]: slipid_observe, then slipid_command. */
void slipid_step(slipid_state *state, const slipid_reading *reading, const slipid_real reference[6],
                 slipid_real dt, slipid_estimate *estimate, slipid_real command[SLIPID_WHEELS]);

@FUNCTIONS@
#ifdef __cplusplus
}
#endif
#endif
