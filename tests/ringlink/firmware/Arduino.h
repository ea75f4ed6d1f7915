// As much of Arduino as the sketch of a ring needs, with a clock of its own.
#pragma once

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

constexpr int LOW = 0, HIGH = 1, INPUT = 0, OUTPUT = 1, LED_BUILTIN = 13;

inline uint64_t now_us = 1000000;

inline uint32_t micros() { return static_cast<uint32_t>(now_us); }
inline uint32_t millis() { return static_cast<uint32_t>(now_us / 1000); }

void pinMode(int pin, int mode);
void digitalWrite(int pin, int level);

// What is written goes to stdout, as it would over USB.
struct FakeSerial {
  void begin(long) {}
  int availableForWrite() { return 1000; }
  void write(const uint8_t* data, size_t size) {
    fwrite(data, 1, size, stdout);
  }
};
inline FakeSerial Serial;
