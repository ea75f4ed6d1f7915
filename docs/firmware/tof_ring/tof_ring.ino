// A ring of eight VL53L1X on one I2C bus that sends its frames over USB.
//
// An example to start from. It was never run on hardware; the tests run it on
// a PC with a simulated bus. It needs a board with USB serial and 32-bit
// arithmetic (Teensy, RP2040, ESP32-S3, ...) and Pololu's library "VL53L1X",
// whose range status has the numbers of ST's API.
//
// Each sensor's XSHUT pin is on a pin of the board. All sensors share one
// address after power-up, so a sensor is off until its turn to get its own.
// A lost sensor is restarted the same way: off, alone at the shared address,
// running. The others go on measuring all the time.
#include <VL53L1X.h>
#include <Wire.h>

#include "ring_frame.h"

constexpr uint8_t kRing = 0;  // 0 base, 1 elbow, 2 tool
constexpr uint8_t kSensors = 8;
constexpr uint8_t kShutdownPin[kSensors] = {2, 3, 4, 5, 6, 7, 8, 9};
constexpr uint8_t kFirstAddress = 0x30;
constexpr uint32_t kTimingBudgetUs = 20000;  // short mode only
constexpr uint32_t kPeriodMs = 24;           // timing budget + 4 ms
// Two frames for each sample: with a frame every 24 ms a sample could wait for
// 24 ms, and be too old for the law's reaction time.
constexpr uint32_t kFrameMs = 12;
constexpr uint32_t kOffMs = 5;         // off for this long: a power cycle
constexpr uint32_t kBootMs = 3;        // 1.2 ms in the datasheet
constexpr uint32_t kRetryMs = 500;     // between two attempts to wake it
constexpr uint32_t kSilenceMs = 200;   // no new sample for this long: it hangs
constexpr uint8_t kMostFailures = 3;   // in a row on the bus: sensor lost
constexpr uint8_t kPeriods = 8;        // over which its own period is averaged

enum class Step : uint8_t { kOff, kBooting, kRunning };

struct Sensor {
  VL53L1X device;
  Step step = Step::kOff;
  uint32_t since_ms = 0;   // when the step began, or the newest sample came
  uint32_t wait_ms = kOffMs;  // stays off for this long
  uint8_t failures = 0;    // on the bus, in a row
  uint32_t polled_us = 0;  // when it was last known to have nothing new
  uint32_t ready_us = 0;   // when its sample was ready, at the earliest
  int32_t period_us = 0;   // from sample to sample, smoothed
  uint8_t periods = 0;     // measured so far; from kPeriods on it is known
  bool has_sample = false;
  bool is_fresh = false;
  ring_frame::Sample sample = {0, ring_frame::kNoNewData, 255, 0};
};

Sensor sensors[kSensors];
uint8_t turn = 0;  // whose turn it is to be woken
bool has_restarted = true;
uint16_t sequence = 0;
uint32_t next_frame_ms = 0;

// Before the first frame: send nothing, so that the robot does not start.
void halt() {
  pinMode(LED_BUILTIN, OUTPUT);
  for (;;) {
    digitalWrite(LED_BUILTIN, millis() / 125 % 2);
  }
}

// Switches a sensor off until its turn: there is never more than one at the
// shared address.
void lose(uint8_t i, uint32_t wait_ms) {
  pinMode(kShutdownPin[i], OUTPUT);
  digitalWrite(kShutdownPin[i], LOW);
  sensors[i] = Sensor();
  sensors[i].since_ms = millis();
  sensors[i].wait_ms = wait_ms;
}

// Gives a sensor that is alone at the shared address its own address and starts
// it. Takes some 10 ms.
bool start(uint8_t i) {
  VL53L1X& device = sensors[i].device;
  device.setTimeout(10);
  if (!device.init()) return false;
  device.setAddress(kFirstAddress + i);
  if (device.last_status != 0) return false;
  if (!device.setDistanceMode(VL53L1X::Short)) return false;
  if (!device.setMeasurementTimingBudget(kTimingBudgetUs)) return false;
  device.startContinuous(kPeriodMs);
  return device.last_status == 0;
}

// A running sensor that does not answer may have lost its address.
bool all_answer() {
  for (uint8_t i = 0; i < kSensors; ++i) {
    if (sensors[i].failures > 0) return false;
  }
  return true;
}

// Does one step for one sensor that is off; called once for each frame.
void wake_sensors() {
  if (!all_answer()) return;
  for (uint8_t i = 0; i < kSensors; ++i) {
    if (sensors[turn].step != Step::kRunning) break;
    turn = (turn + 1) % kSensors;
  }
  Sensor& sensor = sensors[turn];
  const uint32_t elapsed_ms = millis() - sensor.since_ms;
  if (sensor.step == Step::kBooting) {
    if (elapsed_ms < kBootMs) return;
    if (start(turn)) {
      sensor.step = Step::kRunning;
      sensor.since_ms = millis();
      sensor.polled_us = micros();
    } else {
      lose(turn, kRetryMs);
    }
  } else if (sensor.step == Step::kOff && elapsed_ms >= sensor.wait_ms) {
    pinMode(kShutdownPin[turn], INPUT);  // the sensor's board pulls it up
    sensor.step = Step::kBooting;
    sensor.since_ms = millis();
    return;
  }
  turn = (turn + 1) % kSensors;
}

// Takes a sensor's new sample, if there is one. Returns whether it answered.
bool read_sensor(Sensor& sensor) {
  const uint32_t now = micros();
  const bool is_ready = sensor.device.dataReady();
  if (sensor.device.last_status != 0) return false;
  if (!is_ready) {
    sensor.polled_us = now;
    return true;
  }
  sensor.device.read(false);
  if (sensor.device.last_status != 0) return false;
  // It became ready at some time since the last poll: at the earliest then.
  if (sensor.has_sample) {
    const int32_t period_us =
        static_cast<int32_t>(sensor.polled_us - sensor.ready_us);
    if (sensor.periods < kPeriods) ++sensor.periods;
    sensor.period_us += (period_us - sensor.period_us) / sensor.periods;
  }
  sensor.ready_us = sensor.polled_us;
  sensor.polled_us = now;
  sensor.since_ms = millis();
  sensor.has_sample = true;
  sensor.is_fresh = true;
  sensor.sample.mm = sensor.device.ranging_data.range_mm;
  sensor.sample.status =
      static_cast<uint8_t>(sensor.device.ranging_data.range_status);
  return true;
}

void read_sensors() {
  for (uint8_t i = 0; i < kSensors; ++i) {
    Sensor& sensor = sensors[i];
    if (sensor.step != Step::kRunning) continue;
    sensor.failures = read_sensor(sensor) ? 0 : sensor.failures + 1;
    if (sensor.failures >= kMostFailures ||
        millis() - sensor.since_ms > kSilenceMs) {
      lose(i, kOffMs);
    }
  }
}

uint8_t saturate(uint32_t value) {
  return value < 255 ? static_cast<uint8_t>(value) : 255;
}

// An old sample is never sent as a new one.
ring_frame::Sample take_sample(Sensor& sensor, uint32_t now_us) {
  ring_frame::Sample sent = {0, ring_frame::kNoNewData, 255, 0};
  if (sensor.step != Step::kRunning || sensor.failures > 0) {
    sent.status = ring_frame::kBusFailure;
    return sent;
  }
  if (sensor.is_fresh) {
    sent = sensor.sample;
    sent.age_ms = saturate((now_us - sensor.ready_us) / 1000);
    sensor.is_fresh = false;
  }
  if (sensor.periods == kPeriods) {
    sent.period_ms = saturate((sensor.period_us + 500) / 1000);
  }
  return sent;
}

void send_frame() {
  const uint32_t now = micros();
  uint8_t flags = has_restarted ? ring_frame::kRestarted : 0;
  ring_frame::Sample sent[kSensors];
  for (uint8_t i = 0; i < kSensors; ++i) {
    sent[i] = take_sample(sensors[i], now);
    if (sent[i].status == ring_frame::kBusFailure) {
      flags |= ring_frame::kBusError;
    }
  }

  uint8_t frame[ring_frame::kMaxFrameSize];
  uint8_t line[ring_frame::kMaxLineSize];
  const size_t size = ring_frame::stuff(
      frame,
      ring_frame::build(kRing, flags, sequence, now, sent, kSensors, frame),
      line);
  // A frame that does not fit is lost, and the host notices: old frames must
  // not wait in a buffer.
  ++sequence;
  if (Serial.availableForWrite() >= static_cast<int>(size)) {
    Serial.write(line, size);
    has_restarted = false;
  }
}

void setup() {
  Serial.begin(921600);
  if (!ring_frame::check_example()) halt();
  Wire.begin();
  Wire.setClock(400000);
  for (uint8_t i = 0; i < kSensors; ++i) lose(i, kOffMs);
  next_frame_ms = millis();
}

void loop() {
  read_sensors();
  if (static_cast<int32_t>(millis() - next_frame_ms) < 0) return;
  // Frames missed while a sensor was started are not sent later.
  next_frame_ms += kFrameMs;
  if (static_cast<int32_t>(millis() - next_frame_ms) >= 0) {
    next_frame_ms = millis() + kFrameMs;
  }
  send_frame();
  wake_sensors();
}
