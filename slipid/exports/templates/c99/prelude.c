/* All arithmetic below uses one type of number, double or float. */
typedef slipid_real real_t;
#ifdef SLIPID_FLOAT
#define R(x) x##F
#define R_WIDE(x) ((x) > 0 ? FLT_MAX : -FLT_MAX) /* constants beyond the range of float */
#define r_abs fabsf
#define r_atan2 atan2f
#define r_cos cosf
#define r_exp expf
#define r_floor floorf
#define r_log logf
#define r_pow powf
#define r_rem fmodf
#define r_sin sinf
#define r_sqrt sqrtf
#else
#define R(x) x
#define R_WIDE(x) x
#define r_abs fabs
#define r_atan2 atan2
#define r_cos cos
#define r_exp exp
#define r_floor floor
#define r_log log
#define r_pow pow
#define r_rem fmod
#define r_sin sin
#define r_sqrt sqrt
#endif
#define R_INFINITY ((real_t)INFINITY)
#define R_NAN ((real_t)NAN)

/* Inline functions if the compiler optimizes for speed, so that it can vectorize loops. */
#if defined(__GNUC__) && defined(__OPTIMIZE__) && !defined(__OPTIMIZE_SIZE__)
#define SLIPID_INLINE __attribute__((always_inline, unused)) static inline
#elif defined(__GNUC__)
#define SLIPID_INLINE __attribute__((unused)) static
#else
#define SLIPID_INLINE static
#endif

SLIPID_INLINE bool is_finite(real_t x) {
  return x - x == R(0.0);
}

/* As in JAX, the result is NaN if either argument is NaN. */
SLIPID_INLINE real_t r_max(real_t a, real_t b) {
  return ((a > b) | (a != a)) ? a : b;
}

SLIPID_INLINE real_t r_min(real_t a, real_t b) {
  return ((a < b) | (a != a)) ? a : b;
}

SLIPID_INLINE real_t r_sign(real_t x) {
  return (x > R(0.0)) ? R(1.0) : ((x < R(0.0)) ? R(-1.0) : x);
}

SLIPID_INLINE int32_t i_max(int32_t a, int32_t b) {
  return (a > b) ? a : b;
}

SLIPID_INLINE int32_t i_min(int32_t a, int32_t b) {
  return (a < b) ? a : b;
}

/* Integer part of x, limited to +-1e9; 0 if x is NaN. */
SLIPID_INLINE int32_t to_int(real_t x) {
  const real_t held = (x > R(1e9)) ? R(1e9) : ((x < R(-1e9)) ? R(-1e9) : x);
  return (held == held) ? (int32_t)held : 0;
}

/* tanh(x) / y, without a branch: the continued fraction gives tanh(x / 16) = n / d, and four steps
   tanh 2a = 2 n d / (d^2 + n^2) double the argument; errors are at most 7 units in the last place. */
SLIPID_INLINE real_t r_tanh_over(real_t x, real_t y) {
  const real_t held = (x < R(-19.1)) ? R(-19.1) : ((x > R(19.1)) ? R(19.1) : x);
  const real_t z = held * R(0.0625);
  const real_t q = z * z;
  const real_t n0 = z * (R(1.0) + q * (R(0.12121212121212122) + q * R(0.0020202020202020202)));
  const real_t d0 = R(1.0) + q * (R(0.45454545454545453) + q * (R(0.020202020202020204) + q * R(9.62000962000962e-05)));
  const real_t n1 = R(2.0) * n0 * d0;
  const real_t d1 = d0 * d0 + n0 * n0;
  const real_t n2 = R(2.0) * n1 * d1;
  const real_t d2 = d1 * d1 + n1 * n1;
  const real_t n3 = R(2.0) * n2 * d2;
  const real_t d3 = d2 * d2 + n2 * n2;
  const real_t n4 = R(2.0) * n3 * d3;
  const real_t d4 = d3 * d3 + n3 * n3;
  return n4 / (d4 * y);
}

SLIPID_INLINE real_t r_tanh(real_t x) {
  return r_tanh_over(x, R(1.0));
}
