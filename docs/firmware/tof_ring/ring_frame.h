// Builds the frames of docs/ring_link.md. Plain C++11 without libraries, so
// that it runs on any microcontroller and on a PC.
#pragma once

#include <stddef.h>
#include <stdint.h>
#include <string.h>

namespace ring_frame {

constexpr uint8_t kMaxSensors = 16;
constexpr size_t kHeaderSize = 12;
constexpr size_t kSampleSize = 5;
constexpr size_t kMaxFrameSize = kHeaderSize + kSampleSize * kMaxSensors + 2;
// Below 254 bytes COBS adds one byte, and the delimiter another.
constexpr size_t kMaxLineSize = kMaxFrameSize + 2;

constexpr uint8_t kRestarted = 0x01;  // first frame since the device started
constexpr uint8_t kOdd = 0x02;        // turn of the odd sensors
constexpr uint8_t kBusError = 0x04;   // a sensor did not answer
constexpr uint8_t kSelfTest = 0x80;   // made-up numbers

constexpr uint8_t kBusFailure = 253;  // status: the sensor did not answer
constexpr uint8_t kNoNewData = 254;   // status: not ready since the last frame

struct Sample {
  uint16_t mm;        // as measured, whatever the status
  uint8_t status;     // range status, ST API numbers
  uint8_t age_ms;     // from ready to the frame's time; 255: that or more
  uint8_t period_ms;  // the sensor's own, as measured; 0: not known yet
};

// CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, "123456789" -> 0x29B1.
inline uint16_t calc_crc(const uint8_t* data, size_t size) {
  uint16_t crc = 0xFFFF;
  for (size_t i = 0; i < size; ++i) {
    crc ^= static_cast<uint16_t>(data[i] << 8);
    for (int bit = 0; bit < 8; ++bit) {
      const bool carry = (crc & 0x8000) != 0;
      crc = static_cast<uint16_t>(crc << 1);
      if (carry) crc ^= 0x1021;
    }
  }
  return crc;
}

inline uint8_t* put(uint8_t* to, uint32_t value, int bytes) {
  for (int i = 0; i < bytes; ++i) {
    *to++ = static_cast<uint8_t>(value >> (8 * i));
  }
  return to;
}

// Writes a frame of n sensors (8 or 16) and returns its size. The buffer needs
// kMaxFrameSize bytes. A datagram holds one such frame.
inline size_t build(uint8_t ring, uint8_t flags, uint16_t sequence,
                    uint32_t time_us, const Sample* samples, uint8_t n,
                    uint8_t* frame) {
  uint8_t* to = frame;
  *to++ = 'T';
  *to++ = 'R';
  *to++ = 2;  // version
  *to++ = ring;
  *to++ = n;
  *to++ = flags;
  to = put(to, sequence, 2);
  to = put(to, time_us, 4);
  for (uint8_t i = 0; i < n; ++i) {
    to = put(to, samples[i].mm, 2);
    *to++ = samples[i].status;
    *to++ = samples[i].age_ms;
    *to++ = samples[i].period_ms;
  }
  to = put(to, calc_crc(frame, static_cast<size_t>(to - frame)), 2);
  return static_cast<size_t>(to - frame);
}

// Writes a frame of less than 254 bytes as COBS with its delimiter and returns
// the size, which is two bytes more. A serial line carries this form.
inline size_t stuff(const uint8_t* frame, size_t size, uint8_t* line) {
  uint8_t* code = line;  // where the distance to the next zero goes
  uint8_t* to = line + 1;
  for (size_t i = 0; i < size; ++i) {
    if (frame[i] == 0) {
      *code = static_cast<uint8_t>(to - code);
      code = to++;
    } else {
      *to++ = frame[i];
    }
  }
  *code = static_cast<uint8_t>(to - code);
  *to++ = 0;
  return static_cast<size_t>(to - line);
}

// The first example of docs/ring_link.md.
constexpr Sample kExampleSamples[] = {
    {500, 0, 3, 24}, {1234, 0, 5, 24}, {65535, 2, 4, 25}, {0, 254, 255, 48},
    {40, 3, 0, 24}, {812, 1, 12, 0}, {0, 253, 255, 255}, {1300, 7, 9, 23},
};
constexpr uint8_t kExampleFrame[] = {
    0x54, 0x52, 0x02, 0x01, 0x08, 0x00, 0x07, 0x00, 0x40, 0xe2, 0x01, 0x00,
    0xf4, 0x01, 0x00, 0x03, 0x18, 0xd2, 0x04, 0x00, 0x05, 0x18, 0xff, 0xff,
    0x02, 0x04, 0x19, 0x00, 0x00, 0xfe, 0xff, 0x30, 0x28, 0x00, 0x03, 0x00,
    0x18, 0x2c, 0x03, 0x01, 0x0c, 0x00, 0x00, 0x00, 0xfd, 0xff, 0xff, 0x14,
    0x05, 0x07, 0x09, 0x17, 0x1a, 0x8e,
};
constexpr uint8_t kExampleLine[] = {
    0x06, 0x54, 0x52, 0x02, 0x01, 0x08, 0x02, 0x07, 0x04, 0x40, 0xe2, 0x01,
    0x03, 0xf4, 0x01, 0x05, 0x03, 0x18, 0xd2, 0x04, 0x08, 0x05, 0x18, 0xff,
    0xff, 0x02, 0x04, 0x19, 0x01, 0x05, 0xfe, 0xff, 0x30, 0x28, 0x02, 0x03,
    0x06, 0x18, 0x2c, 0x03, 0x01, 0x0c, 0x01, 0x01, 0x0b, 0xfd, 0xff, 0xff,
    0x14, 0x05, 0x07, 0x09, 0x17, 0x1a, 0x8e, 0x00,
};

// Whether this compiler and this machine build the example correctly.
inline bool check_example() {
  uint8_t frame[kMaxFrameSize];
  uint8_t line[kMaxLineSize];
  const size_t size = build(1, 0, 7, 123456, kExampleSamples, 8, frame);
  const size_t line_size = stuff(frame, size, line);
  return size == sizeof(kExampleFrame) &&
         memcmp(frame, kExampleFrame, size) == 0 &&
         line_size == sizeof(kExampleLine) &&
         memcmp(line, kExampleLine, line_size) == 0;
}

}  // namespace ring_frame
