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
        for states, signals in (
            (("stop", "reduced", "normal"), ("d_C", "d_R")),
            ((), ()),
        ):
            schemas = mut.make_schemas(
                links=("base", "tool"), states=states, signals=signals
            )
            for topic, schema in schemas.items():
                with self.subTest(topic=topic, signals=signals):
                    self.assertEqual(find_faults(schema, topic), [])
                    jsonschema.Draft202012Validator.check_schema(schema)

    def test_what_can_be_plotted_is_of_the_run(self):
        monitor = mut.make_schemas(
            links=("a", "b"), states=("low", "high"), signals=("margin",)
        )["/monitor"]["properties"]
        law = monitor["law"]["properties"]
        self.assertEqual(list(law["margin"]["properties"]), ["a", "b"])
        names = monitor["ring_state"]["properties"]["b"]["oneOf"]
        self.assertEqual(names[1], {"title": "high", "const": 1})

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
