@HEAD@
// cmd_vel and joint_states in; wheel speeds, odometry and diagnostics out. Adapt it to your drivers.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include <diagnostic_msgs/msg/diagnostic_array.hpp>
#include <geometry_msgs/msg/twist_stamped.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/imu.hpp>
#include <sensor_msgs/msg/joint_state.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>
#include <std_srvs/srv/trigger.hpp>

#include "slipid.h"

using namespace std::chrono_literals;
using diagnostic_msgs::msg::DiagnosticStatus;

class SlipidNode : public rclcpp::Node {
 public:
  SlipidNode() : Node("slipid") {
    // One joint for each drive, in the order of robot.json; positive directions as in the logs.
    joints_ = declare_parameter("joints", std::vector<std::string>{@JOINTS@});
    cmd_vel_timeout_ = declare_parameter("cmd_vel_timeout", 0.5);  // s, then the robot stops
    const slipid_real start[3] = {0, 0, 0};
    slipid_init(&state_, start);
    slipid_nothing(&reading_);
    speeds_ = create_publisher<std_msgs::msg::Float64MultiArray>("~/commands", 10);
    odometry_ = create_publisher<nav_msgs::msg::Odometry>("~/odometry", 10);
    diagnostics_ = create_publisher<diagnostic_msgs::msg::DiagnosticArray>("/diagnostics", 10);
    cmd_vel_ = create_subscription<geometry_msgs::msg::TwistStamped>(
        "cmd_vel", 10, [this](const geometry_msgs::msg::TwistStamped& m) {
          twist_[0] = static_cast<slipid_real>(m.twist.linear.x);
          twist_[1] = static_cast<slipid_real>(m.twist.linear.y);
          twist_[2] = static_cast<slipid_real>(m.twist.angular.z);
          demanded_ = now();
        });
    joint_states_ = create_subscription<sensor_msgs::msg::JointState>(
        "joint_states", rclcpp::SensorDataQoS(),
        [this](const sensor_msgs::msg::JointState& m) { read(m); });
    if (declare_parameter("use_imu", @GYRO@)) {
      imu_ = create_subscription<sensor_msgs::msg::Imu>(
          "imu", rclcpp::SensorDataQoS(), [this](const sensor_msgs::msg::Imu& m) {
            reading_.gyro = static_cast<slipid_real>(m.angular_velocity.z);
          });
    }
    rearm_ = create_service<std_srvs::srv::Trigger>(
        "~/rearm", [this](const std::shared_ptr<std_srvs::srv::Trigger::Request>,
                          std::shared_ptr<std_srvs::srv::Trigger::Response> answer) {
          slipid_rearm(&state_.controller);
          answer->success = true;
        });
    demanded_ = last_ = now();
    timer_ = create_wall_timer(@PERIOD@ms, [this]() { step(); });
  }

 private:
  void read(const sensor_msgs::msg::JointState& m) {
    for (std::size_t k = 0; k < joints_.size() && k < SLIPID_DRIVES; ++k) {
      const auto found = std::find(m.name.begin(), m.name.end(), joints_[k]);
      const auto i = static_cast<std::size_t>(found - m.name.begin());
      if (i < m.position.size()) reading_.wheel_angle[k] = static_cast<slipid_real>(m.position[i]);
      if (i < m.velocity.size()) reading_.wheel_speed[k] = static_cast<slipid_real>(m.velocity[i]);
      // joint_states has no currents and voltages; fill in reading_.current [A] and reading_.voltage
      // [V] from your motor drivers, since they tell the floors apart.
    }
  }

  void step() {
    const rclcpp::Time time = now();
    const auto dt = static_cast<slipid_real>((time - last_).seconds());
    last_ = time;
    const bool late = !((time - demanded_).seconds() <= cmd_vel_timeout_);
    const slipid_real rest[3] = {0, 0, 0};
    slipid_estimate estimate;
    slipid_real command[SLIPID_DRIVES];
    slipid_drive(&state_, &reading_, late ? rest : twist_, dt, &estimate, command);
    slipid_nothing(&reading_);  // no reading counts twice
    std_msgs::msg::Float64MultiArray speeds;
    speeds.data.assign(command, command + SLIPID_DRIVES);  // rad/s
    speeds_->publish(speeds);
    publish_odometry(estimate, time);
    if (++steps_ % @RATE@ == 0) publish_diagnostics(estimate, time);
  }

  void publish_odometry(const slipid_estimate& estimate, const rclcpp::Time& time) {
    nav_msgs::msg::Odometry m;
    m.header.stamp = time;
    m.header.frame_id = "odom";
    m.child_frame_id = "base_link";
    m.pose.pose.position.x = estimate.pose[0];
    m.pose.pose.position.y = estimate.pose[1];
    m.pose.pose.orientation.z = std::sin(estimate.pose[2] / 2);
    m.pose.pose.orientation.w = std::cos(estimate.pose[2] / 2);
    m.twist.twist.linear.x = estimate.twist[0];
    m.twist.twist.linear.y = estimate.twist[1];
    m.twist.twist.angular.z = estimate.twist[2];
    // diagonals of x, y, z, roll, pitch, yaw; variances of the velocity are those on the worst floor
    const double twist[6] = {@TWIST@};
    const std::size_t axes[3] = {0, 1, 5};
    for (std::size_t i = 0; i < 6; ++i) {
      m.pose.covariance[7 * i] = @UNKNOWN@;
      m.twist.covariance[7 * i] = twist[i];
    }
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t k = 0; k < 3; ++k) {
        m.pose.covariance[6 * axes[i] + axes[k]] = estimate.covariance[3 * i + k];
      }
    }
    odometry_->publish(m);
  }

  void publish_diagnostics(const slipid_estimate& estimate, const rclcpp::Time& time) {
    DiagnosticStatus status;
    status.name = "slipid";
    status.hardware_id = SLIPID_ROBOT;
    const auto add = [&status](const std::string& key, const std::string& value) {
      diagnostic_msgs::msg::KeyValue entry;
      entry.key = key;
      entry.value = value;
      status.values.push_back(entry);
    };
    const auto flag = [&](const char* name, bool set, unsigned char level) {
      add(name, set ? "true" : "false");
      if (!set) return;
      status.level = std::max(status.level, level);
      status.message += std::string(status.message.empty() ? "" : ", ") + name;
    };
    flag("drives_off", state_.controller.drives_off, DiagnosticStatus::ERROR);
    flag("gave_up", state_.controller.gave_up, DiagnosticStatus::ERROR);  // call the service ~/rearm
    flag("stale", estimate.stale, DiagnosticStatus::WARN);
    flag("immobilised", estimate.immobilised, DiagnosticStatus::WARN);
    flag("out_of_range", estimate.out_of_range, DiagnosticStatus::WARN);
    const char* const sensors[4] = {"gyro", "encoder", "current", "pose_fix"};
    for (std::size_t k = 0; k < 4; ++k) {
      add(std::string("rejected_") + sensors[k], std::to_string(static_cast<long>(estimate.rejected[k])));
    }
    diagnostic_msgs::msg::DiagnosticArray m;
    m.header.stamp = time;
    m.status.push_back(status);
    diagnostics_->publish(m);
  }

  slipid_state state_;
  slipid_reading reading_;
  slipid_real twist_[3] = {0, 0, 0};
  rclcpp::Time demanded_, last_;
  std::vector<std::string> joints_;
  double cmd_vel_timeout_;
  unsigned steps_ = 0;
  rclcpp::Publisher<std_msgs::msg::Float64MultiArray>::SharedPtr speeds_;
  rclcpp::Publisher<nav_msgs::msg::Odometry>::SharedPtr odometry_;
  rclcpp::Publisher<diagnostic_msgs::msg::DiagnosticArray>::SharedPtr diagnostics_;
  rclcpp::Subscription<geometry_msgs::msg::TwistStamped>::SharedPtr cmd_vel_;
  rclcpp::Subscription<sensor_msgs::msg::JointState>::SharedPtr joint_states_;
  rclcpp::Subscription<sensor_msgs::msg::Imu>::SharedPtr imu_;
  rclcpp::Service<std_srvs::srv::Trigger>::SharedPtr rearm_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char** argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<SlipidNode>());
  rclcpp::shutdown();
  return 0;
}
