"""Measurement limits of a body-worn IMU, each with its unit and source."""

# [m/s²] by definition (3rd CGPM, 1901), the g of data sheets; on Earth gravity differs from it by less than 0.5 %.
STANDARD_GRAVITY = 9.80665

# A larger value on an axis is in another unit, marks a missing value, or is damaged. The widest ranges on the market
# are ±4000 deg/s = 69.8 rad/s (TDK ICM-20649) and ±400 g = 3923 m/s² (ST H3LIS331DL).
HIGHEST_RATE = 80.0  # [rad/s]
HIGHEST_ACCEL = 4000.0  # [m/s²]
# The squared norm of a plausible vector is below these limits; that of a vector with a NaN is not.
HIGHEST_RATE_SQUARED = 3.0 * HIGHEST_RATE**2
HIGHEST_ACCEL_SQUARED = 3.0 * HIGHEST_ACCEL**2

# No axis saturates below the narrowest ranges on the market, ±125 deg/s = 2.18 rad/s and ±2 g = 19.6 m/s².
NARROWEST_GYRO_RANGE = 2.0  # [rad/s]
NARROWEST_ACCEL_RANGE = 15.0  # [m/s²]

# [s] between samples of a body-worn sensor: a longer step means that the times are in another unit; MEMS sensors give
# at most 32 kHz (TDK ICM-42688).
LONGEST_STEP_S, SHORTEST_STEP_S = 0.5, 1e-6
