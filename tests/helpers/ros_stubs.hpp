// As much of ROS 2 as the exported node uses. `spin` drives a robot whose wheels follow their commands.
#pragma once
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include <type_traits>
#include <vector>

namespace builtin_interfaces::msg {
struct Time {
  double seconds;
};
}  // namespace builtin_interfaces::msg
namespace std_msgs::msg {
struct Header {
  builtin_interfaces::msg::Time stamp;
  std::string frame_id;
};
struct Float64MultiArray {
  std::vector<double> data;
};
}  // namespace std_msgs::msg
namespace geometry_msgs::msg {
struct Vector3 {
  double x = 0, y = 0, z = 0;
};
struct Quaternion {
  double x = 0, y = 0, z = 0, w = 1;
};
struct Pose {
  Vector3 position;
  Quaternion orientation;
};
struct Twist {
  Vector3 linear, angular;
};
struct TwistStamped {
  std_msgs::msg::Header header;
  Twist twist;
};
}  // namespace geometry_msgs::msg
namespace nav_msgs::msg {
struct PoseWithCovariance {
  geometry_msgs::msg::Pose pose;
  double covariance[36] = {};
};
struct TwistWithCovariance {
  geometry_msgs::msg::Twist twist;
  double covariance[36] = {};
};
struct Odometry {
  std_msgs::msg::Header header;
  std::string child_frame_id;
  PoseWithCovariance pose;
  TwistWithCovariance twist;
};
}  // namespace nav_msgs::msg
namespace sensor_msgs::msg {
struct JointState {
  std::vector<std::string> name;
  std::vector<double> position, velocity, effort;
};
struct Imu {
  geometry_msgs::msg::Vector3 angular_velocity;
};
}  // namespace sensor_msgs::msg
namespace diagnostic_msgs::msg {
struct KeyValue {
  std::string key, value;
};
struct DiagnosticStatus {
  static constexpr unsigned char OK = 0, WARN = 1, ERROR = 2;
  unsigned char level = 0;
  std::string name, message, hardware_id;
  std::vector<KeyValue> values;
};
struct DiagnosticArray {
  std_msgs::msg::Header header;
  std::vector<DiagnosticStatus> status;
};
}  // namespace diagnostic_msgs::msg
namespace std_srvs::srv {
struct Trigger {
  struct Request {};
  struct Response {
    bool success = false;
    std::string message;
  };
};
}  // namespace std_srvs::srv

namespace world {
inline double time = 100.0;
inline std::vector<double> speeds;
inline std::vector<std::string> joints;
inline nav_msgs::msg::Odometry odometry;
inline diagnostic_msgs::msg::DiagnosticStatus status;
inline std::function<void(const geometry_msgs::msg::TwistStamped&)> cmd_vel;
inline std::function<void(const sensor_msgs::msg::JointState&)> joint_states;
inline std::function<void(const sensor_msgs::msg::Imu&)> imu;
inline std::function<void(std::shared_ptr<std_srvs::srv::Trigger::Request>,
                          std::shared_ptr<std_srvs::srv::Trigger::Response>)>
    rearm;
inline std::function<void()> step;
inline void take(const std_msgs::msg::Float64MultiArray& m) { speeds = m.data; }
inline void take(const nav_msgs::msg::Odometry& m) { odometry = m; }
inline void take(const diagnostic_msgs::msg::DiagnosticArray& m) { status = m.status.at(0); }
inline auto& slot(geometry_msgs::msg::TwistStamped*) { return cmd_vel; }
inline auto& slot(sensor_msgs::msg::JointState*) { return joint_states; }
inline auto& slot(sensor_msgs::msg::Imu*) { return imu; }
}  // namespace world

namespace rclcpp {
struct Duration {
  double t;
  double seconds() const { return t; }
};
struct Time {
  double t = 0;
  Duration operator-(const Time& other) const { return {t - other.t}; }
  operator builtin_interfaces::msg::Time() const { return {t}; }
};
struct SensorDataQoS {};
template <class M>
struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  void publish(const M& m) { world::take(m); }
};
template <class M>
struct Subscription {
  using SharedPtr = std::shared_ptr<Subscription>;
};
template <class S>
struct Service {
  using SharedPtr = std::shared_ptr<Service>;
};
struct TimerBase {
  using SharedPtr = std::shared_ptr<TimerBase>;
};
class Node {
 public:
  explicit Node(const std::string&) {}
  Time now() const { return {world::time}; }
  template <class T>
  T declare_parameter(const std::string& name, const T& value) {
    if constexpr (std::is_same_v<T, std::vector<std::string>>) world::joints = value;
    return name.empty() ? T() : value;
  }
  template <class M>
  std::shared_ptr<Publisher<M>> create_publisher(const std::string&, int) {
    return std::make_shared<Publisher<M>>();
  }
  template <class M, class Q, class F>
  std::shared_ptr<Subscription<M>> create_subscription(const std::string&, Q, F f) {
    world::slot(static_cast<M*>(nullptr)) = f;
    return std::make_shared<Subscription<M>>();
  }
  template <class S, class F>
  std::shared_ptr<Service<S>> create_service(const std::string&, F f) {
    world::rearm = f;
    return std::make_shared<Service<S>>();
  }
  template <class P, class F>
  TimerBase::SharedPtr create_wall_timer(P, F f) {
    world::step = f;
    return std::make_shared<TimerBase>();
  }
};
inline void init(int, char**) {}
inline void shutdown() {}

// 2 s of cmd_vel, 2 s without one; the wheels follow with the last command
inline void spin(const std::shared_ptr<Node>&) {
  sensor_msgs::msg::JointState joint;
  joint.name = {"other"};
  joint.name.insert(joint.name.end(), world::joints.begin(), world::joints.end());
  joint.position.assign(joint.name.size(), 0.0);
  joint.velocity.assign(joint.name.size(), 0.0);
  for (int k = 0; k < 80; ++k) {
    world::time += 0.05;
    if (k < 40) {
      geometry_msgs::msg::TwistStamped m;
      m.twist.linear.x = 0.1;
      world::cmd_vel(m);
    }
    for (std::size_t i = 0; i < world::speeds.size(); ++i) {
      joint.velocity[i + 1] = world::speeds[i];
      joint.position[i + 1] += 0.05 * world::speeds[i];
    }
    world::joint_states(joint);
    world::step();
    if (k == 39 || k == 79) {
      for (double x : world::speeds) std::printf("%.9f ", x);
      std::printf("%.9f\n", world::odometry.pose.pose.position.x);
    }
  }
  auto answer = std::make_shared<std_srvs::srv::Trigger::Response>();
  world::rearm(std::make_shared<std_srvs::srv::Trigger::Request>(), answer);
  std::printf("%d %d", answer->success, world::status.level);
  for (const auto& one : world::status.values) std::printf(" %s=%s", one.key.c_str(), one.value.c_str());
}
}  // namespace rclcpp
