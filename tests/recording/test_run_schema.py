import unittest

import jsonschema

import tofssm_drake.recording.run_schema as mut

_PLAIN = ["boolean", "string", "number", "integer"]


def find_faults(schema, where):
    """Returns what Foxglove's reader of schemas would refuse.

    It needs one type per property, never null, properties of each object, items
    of one type in each array, and names for numbers only.
    """
    if schema.get("type") != "object" or "properties" not in schema:
        return [f"{where} is not an object with properties"]
    faults = []
    for name, part in schema["properties"].items():
        at = f"{where}.{name}"
        if "oneOf" in part:
            if not all(
                isinstance(choice["const"], int) and choice["title"]
                for choice in part["oneOf"]
            ):
                faults.append(f"{at} has choices other than named numbers")
            continue
        if part.get("type") == "array":
            part = part.get("items", {})
            if part.get("type") in _PLAIN:
                continue
        elif part.get("type") in _PLAIN:
            continue
        faults += find_faults(part, at)
    return faults


class TestSchemas(unittest.TestCase):
    def test_foxglove_can_read_them(self):
        for topic, schema in mut.make_schemas(("a", "b")).items():
            with self.subTest(topic=topic):
                self.assertEqual(find_faults(schema, topic), [])
                jsonschema.Draft202012Validator.check_schema(schema)

    def test_what_foxglove_can_not_read_is_found(self):
        number = {"type": "number"}
        for part in (
            {"type": ["number", "null"]},
            {"type": "null"},
            {"type": "object"},
            {"type": "array"},
            {"type": "array", "items": {"oneOf": []}},
            {"oneOf": [{"const": "x", "title": "X"}]},
            {"type": "object", "properties": {"a": {}}},
        ):
            schema = {"type": "object", "properties": {"x": part, "y": number}}
            self.assertEqual(len(find_faults(schema, "")), 1, part)
