// One MPU-6050 on an ESP32 as a sensor of `wepose live --source udp:9000`.
// Flash one board a segment, each with its own SEGMENT. Every board has a clock of its own; wepose aligns them.
#include <WiFi.h>
#include <WiFiUdp.h>
#include <Wire.h>

const char *SEGMENT = "torso";  // left_upper_arm, left_forearm, right_upper_arm, right_forearm
const char *WIFI_NAME = "lab", *WIFI_PASSWORD = "secret";
const char *HOST = "192.168.1.10";  // the computer that runs: wepose live --source udp:0.0.0.0:9000
const uint16_t PORT = 9000;

const uint8_t MPU = 0x68;
const uint32_t STEP_US = 10000;  // 100 Hz
const float RAD_S = PI / 180.0f / 16.4f;  // of a count at ±2000 deg/s
const float M_S2 = 9.80665f / 4096.0f;    // of a count at ±8 g

WiFiUDP udp;
uint32_t next_us;

void set_register(uint8_t address, uint8_t value) {
  Wire.beginTransmission(MPU);
  Wire.write(address);
  Wire.write(value);
  Wire.endTransmission();
}

int16_t read_word() {
  uint8_t high = Wire.read();
  return (int16_t)(high << 8 | Wire.read());
}

void setup() {
  Wire.begin();
  Wire.setClock(400000);
  set_register(0x6B, 0x01);  // awake, clocked by the gyroscope
  set_register(0x1A, 0x03);  // low-pass at 44 Hz for both
  set_register(0x1B, 0x18);  // ±2000 deg/s
  set_register(0x1C, 0x10);  // ±8 g
  WiFi.begin(WIFI_NAME, WIFI_PASSWORD);
  while (WiFi.status() != WL_CONNECTED) delay(100);
  WiFi.setSleep(false);  // otherwise packets come in bursts of 100 ms
  udp.begin(PORT);
  next_us = micros();
}

void loop() {
  while ((int32_t)(micros() - next_us) < 0) {}
  uint64_t t_us = esp_timer_get_time();
  next_us += STEP_US;
  Wire.beginTransmission(MPU);
  Wire.write(0x3B);
  Wire.endTransmission(false);
  if (Wire.requestFrom(MPU, (uint8_t)14) != 14) return;  // a lost sample stays away: wepose bridges it
  float accel[3], gyro[3];
  for (float &a : accel) a = M_S2 * read_word();
  read_word();  // temperature
  for (float &g : gyro) g = RAD_S * read_word();
  char line[220];
  int size = snprintf(line, sizeof line,
                      "{\"sensor\":\"%s\",\"t\":%.6f,\"gyro\":[%.5f,%.5f,%.5f],\"accel\":[%.4f,%.4f,%.4f]}", SEGMENT,
                      1e-6 * t_us, gyro[0], gyro[1], gyro[2], accel[0], accel[1], accel[2]);
  udp.beginPacket(HOST, PORT);
  udp.write((const uint8_t *)line, size);
  udp.endPacket();
}
