"""Any brand of robot: its reports, connection and driver."""
