"""What a body-worn IMU can measure: each limit is stated here, once, with its unit and where it comes from."""

# [m/s²] by definition (3rd CGPM, 1901), the g of data sheets; on Earth gravity differs from it by less than 0.5 %.
STANDARD_GRAVITY = 9.80665

# No sensor measures more on an axis: it is another unit, a number that stands for a missing value, or damage. The
# widest ranges that are sold are ±4000 deg/s = 69.8 rad/s (TDK ICM-20649) and ±400 g = 3923 m/s² (ST H3LIS331DL).
HIGHEST_RATE = 80.0  # [rad/s]
HIGHEST_ACCEL = 4000.0  # [m/s²]
# The square of a vector that may have been measured is below these; that of one with a NaN is not.
HIGHEST_RATE_SQUARED = 3.0 * HIGHEST_RATE**2
HIGHEST_ACCEL_SQUARED = 3.0 * HIGHEST_ACCEL**2
# Larger numbers are no measurement in any unit; the squares of smaller ones are finite.
LARGEST_NUMBER = 1e30

# Below the narrowest ranges that are sold, ±125 deg/s = 2.18 rad/s and ±2 g = 19.6 m/s², no axis is cut off.
NARROWEST_GYRO_RANGE = 2.0  # [rad/s]
NARROWEST_ACCEL_RANGE = 15.0  # [m/s²]

# Shares by which the mean norm of a static accelerometer is off gravity. Scale errors are 1 to 3 % by the data sheets
# of MEMS sensors, 3 % in a robot's set that is published (OpenAXES); 20 % is another unit, or no gravity.
GRAVITY_ERROR_NOTED = 0.06
GRAVITY_ERROR_REFUSED = 0.2
# The median specific force [m/s²] of a recording: nobody falls, or is thrown at 30 g, for half of it.
MEDIAN_FORCE = (3.0, 300.0)

# [s] from one sample to the next: no sensor that a person wears measures more slowly, the times are in another unit.
LONGEST_STEP_S = 0.5
