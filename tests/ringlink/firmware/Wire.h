#pragma once

struct FakeWire {
  void begin() {}
  void setClock(long) {}
};
inline FakeWire Wire;
