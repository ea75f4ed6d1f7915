// A ring of eight VL53L1X on one I2C bus that sends its frames over USB.
//
// An example to start from. It was never run on hardware. It needs a board
// with USB serial and 32-bit arithmetic (Teensy, RP2040, ESP32-S3, ...) and
// Pololu's library "VL53L1X", whose range status has the numbers of ST's API.
//
// Each sensor's XSHUT pin is on a pin of the board: all sensors share one
// address after power-up and are woken one by one to get their own.
#include <VL53L1X.h>
#include <Wire.h>

#include "ring_frame.h"

constexpr uint8_t kRing = 0;  // 0 base, 1 elbow, 2 tool
constexpr uint8_t kSensors = 8;
constexpr uint8_t kShutdownPin[kSensors] = {2, 3, 4, 5, 6, 7, 8, 9};
constexpr uint8_t kFirstAddress = 0x30;
constexpr uint32_t kTimingBudgetUs = 20000;  // short mode only
constexpr uint32_t kPeriodMs = 24;           // timing budget + 4 ms

VL53L1X sensors[kSensors];
ring_frame::Sample samples[kSensors];
uint32_t ready_us[kSensors];
bool is_fresh[kSensors];
bool is_lost[kSensors];
bool has_restarted = true;
uint16_t sequence = 0;
uint32_t next_frame_ms = 0;

// Whatever is wrong before the first frame: send nothing, so that the robot
// does not start.
void halt() {
  pinMode(LED_BUILTIN, OUTPUT);
  for (;;) {
    digitalWrite(LED_BUILTIN, millis() / 125 % 2);
  }
}

void setup() {
  Serial.begin(921600);
  if (!ring_frame::check_example()) halt();
  Wire.begin();
  Wire.setClock(400000);
  for (uint8_t i = 0; i < kSensors; ++i) {
    pinMode(kShutdownPin[i], OUTPUT);
    digitalWrite(kShutdownPin[i], LOW);
  }
  for (uint8_t i = 0; i < kSensors; ++i) {
    pinMode(kShutdownPin[i], INPUT);  // the sensor's board pulls it up
    delay(3);
    sensors[i].setTimeout(10);
    if (!sensors[i].init()) halt();
    sensors[i].setAddress(kFirstAddress + i);
    sensors[i].setDistanceMode(VL53L1X::Short);
    sensors[i].setMeasurementTimingBudget(kTimingBudgetUs);
  }
  for (uint8_t i = 0; i < kSensors; ++i) sensors[i].startContinuous(kPeriodMs);
  next_frame_ms = millis() + kPeriodMs;
}

// Takes the sensors' new samples. One that does not answer is lost until it
// answers again; its old sample is never sent as a new one.
void read_sensors() {
  for (uint8_t i = 0; i < kSensors; ++i) {
    const bool is_ready = sensors[i].dataReady();
    is_lost[i] = sensors[i].last_status != 0;
    if (is_lost[i] || !is_ready) continue;
    const uint32_t now = micros();
    sensors[i].read(false);
    is_lost[i] = sensors[i].last_status != 0;
    if (is_lost[i]) continue;
    samples[i].mm = sensors[i].ranging_data.range_mm;
    samples[i].status =
        static_cast<uint8_t>(sensors[i].ranging_data.range_status);
    ready_us[i] = now;
    is_fresh[i] = true;
  }
}

void send_frame() {
  const uint32_t now = micros();
  uint8_t flags = has_restarted ? ring_frame::kRestarted : 0;

  ring_frame::Sample sent[kSensors];
  for (uint8_t i = 0; i < kSensors; ++i) {
    sent[i] = {0, ring_frame::kNoNewData, 255};
    if (is_lost[i]) {
      sent[i].status = ring_frame::kBusFailure;
      flags |= ring_frame::kBusError;
    } else if (is_fresh[i]) {
      const uint32_t age_ms = (now - ready_us[i]) / 1000;
      sent[i] = samples[i];
      sent[i].age_ms = age_ms < 255 ? static_cast<uint8_t>(age_ms) : 255;
    }
    is_fresh[i] = false;
  }

  uint8_t frame[ring_frame::kMaxFrameSize];
  uint8_t line[ring_frame::kMaxLineSize];
  const size_t size = ring_frame::stuff(
      frame,
      ring_frame::build(kRing, flags, sequence, now, sent, kSensors, frame),
      line);
  // A frame that does not fit is lost and seen as such: old ones must not
  // wait in a buffer.
  ++sequence;
  if (Serial.availableForWrite() >= static_cast<int>(size)) {
    Serial.write(line, size);
    has_restarted = false;
  }
}

void loop() {
  read_sensors();
  if (static_cast<int32_t>(millis() - next_frame_ms) >= 0) {
    next_frame_ms += kPeriodMs;
    send_frame();
  }
}
