# Puts the project into the environment of a shell or script:  . ./env.sh
# bash, zsh and dash; from another folder too, except in dash. What you have set already is kept.
# To be seen by other machines: export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET before.

if [ -n "${BASH_SOURCE:-}" ]; then
  _ps_root=$(cd "$(dirname "$BASH_SOURCE")" && pwd)
elif [ -n "${ZSH_VERSION:-}" ]; then
  eval '_ps_root=${${(%):-%x}:A:h}'
else
  _ps_root=$(pwd)
fi

_ps_front() {  # variable, folder: put it in front, unless it is there
  eval "_ps_list=\${$1:-}"
  case ":$_ps_list:" in
    *":$2:"*) ;;
    *) export "$1=$2${_ps_list:+:$_ps_list}" ;;
  esac
}

_ps_enter() {
  if [ ! -f "$_ps_root/scripts/setup.py" ]; then
    echo "env.sh: $_ps_root is not the project's root; go there first" >&2
    return 1
  fi
  if [ ! -f "$_ps_root/.venv/setup.json" ] || [ ! -f "$_ps_root/ros2_ws/install/setup.json" ]; then
    echo "env.sh: not set up yet; run 'make setup' in $_ps_root" >&2
    return 1
  fi
  # Each Python of the ROS wheels sets LD_LIBRARY_PATH anew; this mark of an outer one would stop it.
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
  . "$_ps_root/.venv/local_setup.sh"
  export VIRTUAL_ENV="$_ps_root/.venv"
  export COLCON_PYTHON_EXECUTABLE="$_ps_root/.venv/bin/python3"
  if [ -n "${ZSH_VERSION:-}" ]; then
    emulate sh -c '. "$_ps_root/ros2_ws/install/local_setup.sh"'
  else
    . "$_ps_root/ros2_ws/install/local_setup.sh"
  fi
  # ament leaves an empty last entry, which would mean the present folder
  if [ -n "${LD_LIBRARY_PATH:-}" ]; then export LD_LIBRARY_PATH="${LD_LIBRARY_PATH%:}"; fi
  for _ps_package in ps_head_driver ps_reconstruction ps_calibration ps_inspection; do
    _ps_front PATH "$_ps_root/ros2_ws/install/$_ps_package/lib/$_ps_package"
  done
  _ps_front PATH "$_ps_root/.venv/bin"
  eval "$("$_ps_root/.venv/bin/python3" -S \
    "$_ps_root/ros2_ws/src/ps_inspection/ps_inspection/environment.py")"
  export NUMBA_CACHE_DIR="${NUMBA_CACHE_DIR:-$_ps_root/.cache/numba}"
  export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
  if [ -z "${HOME:-}" ]; then  # rclpy wants a place for its logs
    export ROS_LOG_DIR="${ROS_LOG_DIR:-$_ps_root/.cache/ros}"
  fi
}

# colcon's and ROS's scripts use unset variables, so `set -u` and `set -e` pause meanwhile.
_ps_options=$-
set +eu
_ps_enter
_ps_status=$?
case $_ps_options in *u*) set -u ;; esac
case $_ps_options in *e*) set -e ;; esac
unset -f _ps_front _ps_enter
unset _ps_root _ps_list _ps_package _ps_options
[ "$_ps_status" -eq 0 ] && unset _ps_status || { unset _ps_status; return 1; }
