# Arm's GNU compiler: packages gcc-arm-none-eabi and libnewlib-arm-none-eabi of Debian and Ubuntu.
set(CMAKE_SYSTEM_NAME Generic)
set(CMAKE_SYSTEM_PROCESSOR arm)
set(CMAKE_C_COMPILER arm-none-eabi-gcc)
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
