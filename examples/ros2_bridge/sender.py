import json

import rclpy
from eufs_msgs.msg import ConeArrayWithCovariance
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data


def send(message, **content):
    stamp = message.header.stamp
    print(json.dumps({"t": stamp.sec + 1e-9 * stamp.nanosec, **content}), flush=True)


def send_odometry(message):
    twist = message.twist.twist
    send(message, twist=[twist.linear.x, twist.linear.y, twist.angular.z])


def send_cones(message):
    lists = {"blue": message.blue_cones, "yellow": message.yellow_cones}
    cones = [(name, cone.point) for name, listed in lists.items() for cone in listed]
    send(message, detections=[{"x": at.x, "y": at.y, "label": name} for name, at in cones])


rclpy.init()
node = rclpy.create_node("sender")
node.create_subscription(Odometry, "odometry", send_odometry, qos_profile_sensor_data)
node.create_subscription(ConeArrayWithCovariance, "cones", send_cones, qos_profile_sensor_data)
rclpy.spin(node)
