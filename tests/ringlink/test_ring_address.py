import unittest
from unittest import mock

from hypothesis import given
from hypothesis import strategies as st

from tofssm_drake.errors import UserError
import tofssm_drake.ringlink.ring_address as mut


class TestParseRingAddress(unittest.TestCase):
    def test_udp(self):
        address = mut.parse_ring_address("udp://127.0.0.1:5005")
        self.assertEqual(
            address,
            mut.UdpAddress(host="127.0.0.1", port=5005, senders=("127.0.0.1",)),
        )
        self.assertEqual(str(address), "udp://127.0.0.1:5005")
        self.assertEqual(
            mut.parse_ring_address("udp://localhost:5005"), address
        )

    def test_named_senders(self):
        address = mut.parse_ring_address(
            "udp://192.168.1.10:5005?from=192.168.1.20,192.168.1.21"
        )
        self.assertEqual(address.host, "192.168.1.10")
        self.assertEqual(address.senders, ("192.168.1.20", "192.168.1.21"))

    def test_serial(self):
        self.assertEqual(
            mut.parse_ring_address("serial:///dev/ttyACM0"),
            mut.SerialAddress(path="/dev/ttyACM0", baud=921600),
        )
        address = mut.parse_ring_address("serial:///dev/ttyUSB1?baud=115200")
        self.assertEqual(address.baud, 115200)
        self.assertEqual(str(address), "serial:///dev/ttyUSB1")

    def test_every_interface_only_on_request(self):
        text = "udp://0.0.0.0:5005?from=10.0.0.2"
        with self.assertRaisesRegex(UserError, "--allow-remote"):
            mut.parse_ring_address(text)
        address = mut.parse_ring_address(text, allow_remote=True)
        self.assertEqual(address.senders, ("10.0.0.2",))
        with self.assertRaisesRegex(UserError, "name the sender"):
            mut.parse_ring_address("udp://0.0.0.0:5005", allow_remote=True)

    def test_broadcasts_are_refused(self):
        with mock.patch.object(
            mut, "find_broadcast_address", lambda name: "192.168.1.255"
        ):
            for host in (
                "255.255.255.255",
                "192.168.1.255",
                "127.255.255.255",
            ):
                for allow_remote in (False, True):
                    with (
                        self.subTest(host=host),
                        self.assertRaisesRegex(UserError, "for broadcasts"),
                    ):
                        mut.parse_ring_address(
                            f"udp://{host}:5005?from=10.0.0.2",
                            allow_remote=allow_remote,
                        )
            # Of a larger network.
            mut.parse_ring_address("udp://192.168.2.255:5?from=10.0.0.2")

    def test_asks_the_system_for_broadcasts(self):
        for name in mut.list_interfaces():
            found = mut.find_broadcast_address(name)
            self.assertRegex(found, r"^$|^\d+\.\d+\.\d+\.\d+$")
            self.assertNotEqual(found, "127.0.0.1")
        self.assertEqual(mut.find_broadcast_address("none"), "")

    def test_one_port_twice(self):
        first, second, third = (
            mut.parse_ring_address(text)
            for text in (
                "udp://127.0.0.1:5005",
                "udp://127.0.0.1:5005?from=127.0.0.2",
                "udp://127.0.0.1:5006",
            )
        )
        mut.require_distinct([first, third])
        with self.assertRaisesRegex(UserError, "127.0.0.1:5005 is given twice"):
            mut.require_distinct([first, third, second])

    def test_named_interface(self):
        self.assertEqual(
            mut.parse_ring_address("udp://lo:5005"),
            mut.UdpAddress(
                host="127.0.0.1",
                port=5005,
                senders=("127.0.0.1",),
                interface="lo",
            ),
        )
        # Capitals count.
        with self.assertRaisesRegex(UserError, "'LO' is not"):
            mut.parse_ring_address("udp://LO:5005")
        for addresses, message in (
            ({"lo": "127.0.0.1", "eth0": "10.0.0.1"}, "name the sender"),
            ({"lo": "127.0.0.1", "eth0": ""}, "has no IPv4 address"),
            ({"lo": "127.0.0.1"}, r"interface of this machine \(lo\)"),
        ):
            with (
                self.subTest(addresses=addresses),
                mock.patch.object(
                    mut, "list_interfaces", lambda a=addresses: list(a)
                ),
                mock.patch.object(mut, "find_interface_address", addresses.get),
            ):
                with self.assertRaisesRegex(UserError, message):
                    mut.parse_ring_address("udp://eth0:5005")
                if addresses.get("eth0"):
                    address = mut.parse_ring_address(
                        "udp://eth0:5005?from=10.0.0.9"
                    )
                    self.assertEqual(address.host, "10.0.0.1")
                    self.assertEqual(address.senders, ("10.0.0.9",))

    def test_reports_what_is_wrong_in_one_line(self):
        for text, reason in (
            ("", "not an address"),
            ("127.0.0.1:5005", "not an address"),
            ("tcp://127.0.0.1:5005", "not an address"),
            ("udp://127.0.0.1:5005#x", "not an address"),
            ("udp://127.0.0.1", "no port"),
            ("udp://127.0.0.1:0", "no port"),
            ("udp://127.0.0.1:70000", "not an address"),
            ("udp://127.0.0.1:x", "not an address"),
            ("udp://127.0.0.1:5005/rings", "no port"),
            ("udp://:5005", "IPv4"),
            ("udp://ring.local:5005", "'ring.local' is not an IPv4"),
            ("udp://[::1]:5005", "IPv4"),
            ("udp://me@127.0.0.1:5005", "no user"),
            ("udp://224.0.0.1:5005", "group"),
            ("udp://127.0.0.1:5005?from=", "IPv4"),
            ("udp://127.0.0.1:5005?from=1.2.3.4&from=1.2.3.5", "twice"),
            ("udp://127.0.0.1:5005?baud=9600", "'baud' is unknown"),
            ("udp://127.0.0.1:5005?x", "not an address"),
            ("serial://dev/ttyACM0", "no device"),
            ("serial:///", "no device"),
            ("serial:///dev/ttyACM0?baud=0", "baud '0'"),
            ("serial:///dev/ttyACM0?baud=fast", "baud 'fast'"),
            ("serial:///dev/ttyACM0?baud=-9600", "baud"),
            ("serial:///dev/ttyACM0?parity=n", "'parity' is unknown"),
        ):
            with self.subTest(text=text):
                with self.assertRaises(UserError) as caught:
                    mut.parse_ring_address(text, where="--to")
                message = str(caught.exception)
                self.assertTrue(message.startswith("--to: "), message)
                self.assertIn(reason, message)
                self.assertNotIn("\n", message)

    @given(st.binary(max_size=40))
    def test_any_text_is_an_address_or_a_mistake(self, data):
        text = data.decode("latin-1")
        for prefix in ("", "udp://", "udp://1.2.3.4:5?", "serial:///"):
            try:
                mut.parse_ring_address(prefix + text)
            except UserError:
                pass


if __name__ == "__main__":
    unittest.main()
