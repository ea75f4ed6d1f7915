// Runs the sketch of a ring on a PC:
//
//   run_sketch DURATION_MS SLOWNESS [SENSOR FATE TIME_MS]...
//
// FATE is dies, never, hangs or brownout. The frames go to stdout as over a
// serial line, what went wrong on the bus to stderr.
#include "Arduino.h"

#include <stdlib.h>
#include <string.h>

#include "tof_ring.ino"

void pinMode(int pin, int mode) {
  Chip& chip = chips[pin - 2];
  if (mode == INPUT && !chip.has_power) {
    const bool was_off_long = now_us - chip.off_us >= 2000;
    const Fate fate = chip.fate;
    chip = Chip();
    chip.on_us = now_us;
    if (fate == Fate::kNever || !was_off_long) chip.fate = fate;
  }
}

void digitalWrite(int pin, int level) {
  Chip& chip = chips[pin - 2];
  if (level == LOW && chip.has_power) {
    chip.has_power = false;
    chip.off_us = now_us;
  }
}

Fate read_fate(const char* name) {
  if (strcmp(name, "dies") == 0) return Fate::kDies;
  if (strcmp(name, "never") == 0) return Fate::kNever;
  if (strcmp(name, "hangs") == 0) return Fate::kHangs;
  return Fate::kBrownout;
}

void meet_fate(Chip& chip, Fate fate) {
  if (fate == Fate::kBrownout) {
    chip.address = kSharedAddress;
    chip.period_us = 0;
  } else {
    chip.fate = fate;
  }
}

int main(int count, char** arguments) {
  const uint64_t begin = now_us;
  const uint64_t end = begin + 1000 * strtoull(arguments[1], nullptr, 10);
  slowness = atof(arguments[2]);
  bool is_met[kChips] = {};
  setup();
  while (now_us < end) {
    for (int i = 3; i + 2 < count; i += 3) {
      const int chip = atoi(arguments[i]);
      if (is_met[chip] || now_us < begin + 1000 * atoll(arguments[i + 2])) {
        continue;
      }
      is_met[chip] = true;
      meet_fate(chips[chip], read_fate(arguments[i + 1]));
    }
    loop();
    now_us += 50;
  }
  fprintf(stderr, "%d collisions, %d early\n", collisions, early);
  return 0;
}
