/* A brushed motor on a supply in fine fixed steps; the structs mirror the dataclasses of motor_physics.py. */
#include <math.h>

typedef struct {
  double voltage, resistance, back_emf, inductance, inertia, coulomb, viscous;
  double drop_shape, drop, drop_current, film, film_current;
  double stribeck, stribeck_speed, cogging, cogging_order, ripple, ripple_order;
  double copper_slope, magnet_slope, thermal_resistance, winding_time, magnet_time;
} motor;

typedef struct {
  double row, substeps, ramp, pwm_frequency, bus;
} supply;

typedef struct {
  double current, mean_current, speed, angle, winding_rise, magnet_rise;
} state;

typedef struct {
  double value, slope;
} line;

/* Voltage across the brushes [V] and its slope [ohm] at a current [A]. */
static line brush_drop(const motor *m, double current) {
  if (m->drop_shape == 0) return (line){0, 0};
  const double s = fabs(current) / m->drop_current;
  double value, slope;
  if (m->drop_shape == 1) {
    value = tanh(s), slope = 1 - value * value;
  } else if (m->drop_shape == 2) {
    slope = exp(-s), value = 1 - slope;
  } else if (m->drop_shape == 3) {
    value = s / (1 + s), slope = 1 / ((1 + s) * (1 + s));
  } else {
    value = log1p(s), slope = 1 / (1 + s);
  }
  return (line){copysign(m->drop * value, current), m->drop / m->drop_current * slope};
}

/* Voltage across copper and contact film [V] and its slope [ohm]. */
static line ohmic(const motor *m, double current, double rise) {
  const double copper = m->resistance * (1 + m->copper_slope * rise);
  if (m->film == 0) return (line){copper * current, copper};
  const double x = fabs(current) / m->film_current, film = m->film * exp(-x);
  return (line){(copper + film) * current, copper + film * (1 - x)};
}

/* Torque over current [N m/A]; the energy balance makes it the induced voltage over speed too. */
static double coupling(const motor *m, double angle, double rise) {
  const double mean = m->back_emf * (1 + m->magnet_slope * rise);
  return m->ripple == 0 ? mean : mean * (1 + m->ripple * cos(m->ripple_order * angle));
}

/* Integral of a unit pulse train of one duty, over x periods. */
static double pulses(double x, double duty) {
  const double whole = floor(x);
  return whole * duty + fmin(x - whole, duty);
}

/* Mean voltage of one step: the command itself, or pulses between 0 and the bus voltage. */
static double applied(const supply *s, double command, double time, double step) {
  if (s->pwm_frequency == 0) return command;
  const double duty = fabs(command) / s->bus, x = time * s->pwm_frequency, dx = step * s->pwm_frequency;
  return copysign(s->bus * (pulses(x + dx, duty) - pulses(x, duty)) / dx, command);
}

/* Current after one step of the implicit midpoint rule, by three steps of Newton's method. */
static double next_current(const motor *m, double current, double rise, double driving, double step) {
  const double a = step / (2 * m->inductance);
  double middle = current;
  for (int k = 0; k < 3; ++k) {
    const line r = ohmic(m, middle, rise), b = brush_drop(m, middle);
    const double error = middle - current - a * (driving - r.value - b.value);
    middle -= error / (1 + a * (r.slope + b.slope));
  }
  return 2 * middle - current;
}

/* Speed after one step; dry friction takes no more than what moves. */
static double next_speed(const motor *m, double speed, double angle, double torque, double step) {
  const double b = m->viscous * step / (2 * m->inertia);
  double dry = m->coulomb;
  if (m->stribeck > 0) dry *= 1 + m->stribeck * exp(-pow(speed / m->stribeck_speed, 2));
  if (m->cogging > 0) torque -= m->cogging * sin(m->cogging_order * angle);
  const double free = ((1 - b) * speed + torque * step / m->inertia) / (1 + b);
  return copysign(fmax(fabs(free) - dry * step / m->inertia / (1 + b), 0), free);
}

/* States at the rows' times. Currents stand at whole steps and speeds at half steps (leapfrog), which keeps
   the energy that the coupling moves. The mean current is that of the PWM period before the row. */
void simulate(const motor *m, const supply *s, long rows, const double *command, state *out) {
  const long substeps = (long)s->substeps;
  const double step = s->row / s->substeps;
  const long window = s->pwm_frequency > 0 ? lround(fmin(1 / s->pwm_frequency, s->row) / step) : 1;
  double current = 0, speed = 0, before = 0, angle = 0, winding = 0, magnet = 0, mean = 0;
  for (long k = 0; k < rows; ++k) {
    out[k] = (state){current, mean, (before + speed) / 2, angle, winding, magnet};
    const double slope = s->ramp > 0 && k + 1 < rows ? (command[k + 1] - command[k]) / s->substeps : 0;
    mean = 0;
    for (long n = 0; n < substeps; ++n) {
      const double voltage = applied(s, command[k] + slope * (n + 0.5), (k + n / s->substeps) * s->row, step);
      const double induced = coupling(m, angle + speed * step / 2, magnet) * speed;
      current = next_current(m, current, winding, voltage - induced, step);
      angle += step * speed;
      before = speed;
      speed = next_speed(m, speed, angle, coupling(m, angle, magnet) * current, step);
      if (m->thermal_resistance > 0) {
        const double heat = ohmic(m, current, winding).value * current;
        winding += step * (m->thermal_resistance * heat - winding) / m->winding_time;
        magnet += step * (winding / 2 - magnet) / m->magnet_time;
      }
      if (n >= substeps - window) mean += current / window;
    }
  }
}
