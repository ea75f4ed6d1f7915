"""Layout of the ground truth's vector, shared by its writer and readers."""


class TruthLayout:
    """Where each quantity sits in the vector of a `TruthModel`.

    Attributes:
        num_rings: Number m of watched links.
        size: Length of the vector.
        distance: Least distance between robot and person, m; negative is the
            depth of penetration, inf: no person.
        p_WR: Point on the robot's surface where it is least; NaN: no person.
        p_WH: Point on the person's surface, likewise.
        robot_body: Index of that robot body in `TruthModel.body_names`.
        person_part: Index of the person's capsule; -1: no person.
        contact_speed: Speed of the fastest touching robot point, m/s; 0 when
            nothing touches.
        p_WT: Position of the tool centre point.
        tcp_speed: Its speed, m/s.
        ring_distance: From each link's centre to the person's surface, m.
        ring_azimuth: Direction of that nearest point of the person about the
            ring's axis (z), from the ring's x axis, rad.
        ring_elevation: The same above the ring's plane, rad.
        person: Ground position (x, y) of the person's pelvis.
    """

    def __init__(self, num_rings: int):
        m = num_rings
        self.num_rings = m
        self.distance = 0
        self.p_WR = slice(1, 4)
        self.p_WH = slice(4, 7)
        self.robot_body = 7
        self.person_part = 8
        self.contact_speed = 9
        self.p_WT = slice(10, 13)
        self.tcp_speed = 13
        self.person = slice(14, 16)
        self.ring_distance = slice(16, 16 + m)
        self.ring_azimuth = slice(16 + m, 16 + 2 * m)
        self.ring_elevation = slice(16 + 2 * m, 16 + 3 * m)
        self.size = 16 + 3 * m
