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
#define slipid_init slipid_init_float
#define slipid_step slipid_step_float
#define slipid_begin slipid_begin_float
#define slipid_nothing slipid_nothing_float
#define slipid_observe slipid_observe_float
#define slipid_command slipid_command_float
#define slipid_follow slipid_follow_float
#else
typedef double slipid_real;
#endif

/* Hash of the robot's numbers, as robot.json has it. */
#define SLIPID_ROBOT "@ROBOT@"
@DEFINES@

@ABOUT@

/* What the estimator keeps. */
@ESTIMATOR@

/* What the controller keeps. */
@CONTROLLER@

/* What the sensors give; NaN where there is none. */
@READING@

/* What is believed. */
@ESTIMATE@

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

/* Start estimator and controller of a robot that stands at a pose: x, y [m], heading [rad]. */
@BEGIN@

/* Make a reading one of no sensor at all; fill in what there is. */
@NOTHING@

/* Take in what the sensors give dt after the last call [s]: the estimator's step. */
@OBSERVE@

/* Wheel speeds to command [rad/s] for a reference, x, y [m], heading [rad] and their rates in the
   world [m/s, m/s, rad/s]: the controller's step. */
@COMMAND@

@FOLLOWABOUT@
@FOLLOW@

#ifdef __cplusplus
}
#endif
#endif
